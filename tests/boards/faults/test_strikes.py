"""Faults of every kind in lockstep: each strikes, is found and is over as it was before."""

from __future__ import annotations

from typing import Any

import pytest

from rack.boards.faults.kind import KINDS, Kind
from tests.boards.conftest import LOOSE, MakeConfig
from tests.boards.fault_racks import DRIVEN, FOLLOWED, OF_KINDS, TARGETS
from tests.boards.runs import digest_of, faulty
from tests.snapshots import Snapshots
from tests.whole_runs import in_short, whole_run

pytestmark = [pytest.mark.slow, pytest.mark.thorough]
SNAPSHOTS = Snapshots(__file__)
SECONDS = 1.5
STRIKES: tuple[dict[str, Any], ...] = (
    {"tick": 101, "seed": 5, "cycles": 3},
    {"tick": 250, "seed": 6, "for": 0.11},
    {"tick": 420, "for": 0.3},
)
BY_ORDER = ("mute", "masquerade")
"""Kinds that a reader finds, or not, by whether it or the writer comes first in a tick."""
LOCKSTEP = [kind for kind in KINDS if not kind.realtime and kind.where != "start"]


RACKS = {"followed": FOLLOWED, "driven": DRIVEN}
CASES = [
    pytest.param(kind, rack, id=f"{kind.name}, {rack}")
    for kind in LOCKSTEP
    for rack in RACKS
    if rack == "driven" or kind.where != "arm"  # the followed rack has none
]


@pytest.mark.parametrize("kind", ["kill", "hang"])
def test_a_fault_at_the_first_tick_acts_like_a_later_one(kind: str, config: MakeConfig) -> None:
    struck = faulty(config(text=FOLLOWED), {"kind": kind, "board": "wave", "tick": 0})
    SNAPSHOTS.check(f"{kind} at the first tick", in_short(whole_run(struck, SECONDS)))


@pytest.mark.parametrize(("kind", "rack"), CASES)
def test_the_effect_of_each_fault_is_unchanged(kind: Kind, rack: str, config: MakeConfig) -> None:
    board = TARGETS.get(kind.name, TARGETS.get(kind.where, "wave"))
    lasting = ("cycles", "for") if kind.once else ()
    faults = [
        {"kind": kind.name, "board": board}
        | {key: value for key, value in strike.items() if key not in lasting}
        for strike in STRIKES
    ]
    struck = faulty(config(*OF_KINDS.get(kind.where, ()), text=RACKS[rack]), *faults)
    parts = dict(whole_run(struck, SECONDS))
    if kind.name in BY_ORDER:
        del parts["events"]
    SNAPSHOTS.check(f"{kind.name}, {rack}", in_short(parts))


@pytest.mark.parametrize(
    ("kind", "coupling"),
    [("drop", ()), ("reorder", ()), ("delay", LOOSE), ("masquerade", LOOSE)],
)
def test_a_run_with_a_fault_of_a_planner_repeats(
    kind: str, coupling: tuple[str, ...], config: MakeConfig
) -> None:
    lasts = {} if KINDS[kind].once else {"cycles": 80}
    fault = {"kind": kind, "board": "wave.planner", "tick": 101, **lasts}
    struck = faulty(config(*coupling), fault)
    assert digest_of(struck, 1.0) == digest_of(struck, 1.0)
