"""Small racks of every kind in lockstep run as recorded."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.boards.commanded_racks import COMMANDED
from tests.boards.conftest import LOOSE, PLAIN, PLANNED, MakeConfig
from tests.boards.run.test_exchange import TEXT as EXCHANGE
from tests.boards.run.test_interrupts import OVERLOADED, RACK, SMALL
from tests.boards.table_racks import counting
from tests.boards.test_modifications import TEXT as MODIFIED
from tests.boards.test_queues import FAST, PLANNING, QUEUES
from tests.boards.vector_racks import JOINTED
from tests.snapshots import Snapshots
from tests.whole_runs import in_short, whole_run

pytestmark = [pytest.mark.slow, pytest.mark.thorough]
SNAPSHOTS = Snapshots(__file__)
SECONDS = 1.5
CASES: dict[str, tuple[str, tuple[str, ...]]] = {
    "plain": (PLAIN, ()),
    "planned": (PLANNED, ()),
    "loose": (PLANNED, LOOSE),
    "lock": (PLANNED, ("protocol.default=lock",)),
    "phases": (PLANNED, ("board.watch.phase=3",)),
    "queues": (QUEUES, ()),
    "fast queues": (QUEUES, FAST),
    "planning queues": (PLANNING, ()),
    "exchange": (EXCHANGE, ()),
    "interrupts": (RACK, ()),
    "small inbox": (RACK, (SMALL,)),
    "overloaded inbox": (RACK, (OVERLOADED,)),
    "neighbours": (JOINTED, ()),
    "modified": (MODIFIED, ()),
    "commanded": (COMMANDED, ()),
}


@pytest.mark.parametrize("case", CASES)
def test_the_recorded_run_of_a_small_rack_is_unchanged(case: str, config: MakeConfig) -> None:
    text, settings = CASES[case]
    SNAPSHOTS.check(case, in_short(whole_run(config(*settings, text=text), SECONDS)))


def test_the_recorded_run_of_a_state_table_rack_is_unchanged(
    config: MakeConfig, tmp_path: Path
) -> None:
    SNAPSHOTS.check("tables", in_short(whole_run(config(text=counting(tmp_path)), SECONDS)))
