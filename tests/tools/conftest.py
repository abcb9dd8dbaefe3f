"""Runs, configs and shared memory that tests of several folders use."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.segment import Segment, unlink_segment
from rack.boards.config import RackConfig, load, resolve_layout
from rack.tools.recording.recording import Recording
from tests.boards.commanded_racks import COMMANDED
from tests.shared_runs import nasrem_run, small_run
from tests.tools.recordings import Traces, recorded

MakeSegment = Callable[[RackConfig], Segment]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the small rack."""
    return small_run(tmp_path_factory)


@pytest.fixture(scope="module")
def nasrem(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A short run of the NASREM rack."""
    return Recording(nasrem_run(tmp_path_factory))


@pytest.fixture
def damaged(run: Path, tmp_path: Path) -> Path:
    """A copy of a short run, which a test may damage."""
    return Path(shutil.copytree(run, tmp_path / "run"))


@pytest.fixture
def config(small: Path, rack_name: str) -> RackConfig:
    """A rack of two levels that count, without an arm."""
    return load(small, [f"name={rack_name}"])


@pytest.fixture
def commanded(write: Callable[[str, str], Path]) -> Path:
    """A rack whose levels take commands of operators, as a file."""
    return write("commanded.toml", COMMANDED)


@pytest.fixture
def make_segment() -> Iterator[MakeSegment]:
    """Make the shared memory of racks that are not launched."""
    with ExitStack() as stack:

        def make(config: RackConfig) -> Segment:
            segment = Segment.create(resolve_layout(config), config.to_toml_text())
            stack.callback(unlink_segment, segment.rack)
            stack.callback(segment.close)
            return segment

        yield make


Record = Callable[..., Recording]


@pytest.fixture
def record(small: Path, tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Write recordings of the small rack, by default in real time, with synthetic traces."""

    def write_recording(traces: Traces, *settings: str, **more: Any) -> Recording:
        config = load(small, ["clock.mode=realtime", *settings])
        return recorded(tmp_path_factory.mktemp("run"), config, traces, **more)

    return write_recording
