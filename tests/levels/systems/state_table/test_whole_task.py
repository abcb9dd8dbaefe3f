"""The rack of state tables repeats its task with all messages, as in the snapshots."""

from __future__ import annotations

import pytest

from rack.boards.config import load
from tests import golden
from tests.snapshots import Snapshots
from tests.whole_runs import whole_run

pytestmark = pytest.mark.thorough
SNAPSHOTS = Snapshots(__file__)


@pytest.fixture(scope="module", autouse=True)
def _rounded_alike() -> None:
    if golden.machine()["libm"] != golden.read()["machine"]["libm"]:
        pytest.skip("this C library rounds differently from the one of the snapshots")


@pytest.mark.parametrize(
    ("name", "faults", "seconds"),
    [
        ("nist-state-table", None, 30.0),
        ("nist-state-table", "kill-each-board", 20.0),
        ("nist-state-table/three-poses", None, 8.0),
    ],
)
def test_the_task_repeats_its_snapshot(
    name: str, faults: str | None, seconds: float, rack_name: str
) -> None:
    config = load(name, [f"name={rack_name}", "clock.mode=lockstep"], faults)
    parts = whole_run(config, seconds)
    case = name if faults is None else f"{name}, {faults}"
    SNAPSHOTS.check(case, {part: parts[part] for part in ("messages", "struck", "end")})
