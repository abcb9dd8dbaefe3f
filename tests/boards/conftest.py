"""Racks of waves for tests, and the check that they leave nothing behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.segment import SHM_FOLDER, Segment, unlink_segment
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.config.toml import to_toml
from tests.backplane.conftest import make_bus  # noqa: F401  a fixture
from tests.processes import named, wait_until

CLOCK = f"""
format = 2
name = "waves"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 2.5
mode = "lockstep"
"""


def format_board(name: str, slot: int, executor: str, **keys: object) -> str:
    """Return the table of a board, as TOML."""
    return to_toml({"board": {name: {"slot": slot, "executor": executor, **keys}}})


def format_figure(name: str, slot: int, process_ms: float, **keys: object) -> str:
    """Return the table of a board that takes no time, and has this budget."""
    keys |= {"params": {"process_ms": 0.0}, "budget": {"process_ms": process_ms}}
    return format_board(name, slot, "rack.levels.systems.figures:FigureLoop", **keys)


PLAIN = (
    CLOCK
    + format_board("wave", 2, "wave_levels:Wave", core=1, rate_hz=400)
    + format_board("watch", 3, "wave_levels:Watch", rate_hz=50, below="wave", ends_run=True)
)
PLANNED = PLAIN.replace(
    '"wave_levels:Wave"',
    """"wave_levels:PlannedWave"
planner = "wave_levels:GainPlanner"
coupling = "tight"
within_cycles = 4""",
)
LOOSE = ("board.wave.coupling=loose", "board.wave.planner_slot=9")
"""Settings that give the wave's planner its own board."""

NEVER = "supervision.restarts=0"
"""Setting with which the loss of a board ends the run."""

UNJUDGED = "supervision.max_missed_fraction=1"
"""Setting with which no run fails because of its lost cycles: in real time the machine may be busy,
and in lockstep a board that is killed from outside loses many of a short run."""

MakeConfig = Callable[..., RackConfig]
MakeSegment = Callable[..., Segment]


@pytest.fixture
def config(rack_name: str, tmp_path: Path) -> Iterator[MakeConfig]:
    """Configs of this test's own rack, with settings; checks that it leaves nothing behind."""

    def make(*settings: str, text: str = PLANNED) -> RackConfig:
        path = tmp_path / "waves.toml"
        path.write_text(text)
        return load(path, [f"name={rack_name}", UNJUDGED, *settings])

    yield make
    wait_until(lambda: not named(f"{rack_name}:"))
    assert not [path.name for path in SHM_FOLDER.iterdir() if rack_name in path.name]


@pytest.fixture
def make_segment() -> Iterator[MakeSegment]:
    """Return a function that creates a segment, which is removed at the end of the test."""
    with ExitStack() as stack:

        def make(*content: Any) -> Segment:
            segment = Segment.create(*content)
            stack.callback(unlink_segment, segment.rack)
            stack.callback(segment.close)
            return segment

        yield make
