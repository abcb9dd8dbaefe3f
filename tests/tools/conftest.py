"""Runs, configs and shared memory that tests of several folders use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from rack.backplane.segment import Segment, unlink_segment
from rack.boards.config import RackConfig, load, resolve_layout
from tests.boards.commanded_racks import COMMANDED
from tests.shared_runs import small_run

MakeSegment = Callable[[RackConfig], Segment]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the small rack."""
    return small_run(tmp_path_factory)


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
