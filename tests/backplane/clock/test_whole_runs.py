"""Clocks of whole racks that lose boards and ticks behave as recorded."""

from __future__ import annotations

from typing import Any

import pytest

from rack.boards.faults.config import FaultConfig
from tests.boards.conftest import PLAIN, PLANNED, MakeConfig, config  # noqa: F401  a fixture
from tests.boards.fault_racks import DRIVEN, FOLLOWED
from tests.boards.run.test_exchange import TEXT as EXCHANGE
from tests.snapshots import Snapshots
from tests.whole_runs import in_short, whole_run

pytestmark = pytest.mark.thorough
SNAPSHOTS = Snapshots(__file__)
SECONDS = 1.5
RACKS: dict[str, tuple[str, tuple[str, ...]]] = {
    "planned": (PLANNED, ()),
    "phase": (PLAIN, ("board.watch.phase=3",)),
    "given up": (FOLLOWED, ("supervision.restarts=0",)),
    "driven": (DRIVEN, ()),
    "exchange": (EXCHANGE, ()),
}
LOST: tuple[dict[str, Any], ...] = (
    {"kind": "kill", "board": "wave", "tick": 101},
    {"kind": "clock-skip", "board": "clock", "tick": 150},
    {"kind": "hang", "board": "watch", "tick": 240, "for": 0.1},
)


@pytest.mark.parametrize("case", RACKS)
def test_the_recorded_run_of_the_clock_is_unchanged(
    case: str,
    config: MakeConfig,  # noqa: F811
) -> None:
    text, settings = RACKS[case]
    rack = config(*settings, text=text)
    faults = [FaultConfig(**fault) for fault in LOST if fault["board"] in (*rack.board, "clock")]
    rack = rack.model_copy(update={"fault": tuple(faults)})
    SNAPSHOTS.check(case, in_short(whole_run(rack, SECONDS)))
