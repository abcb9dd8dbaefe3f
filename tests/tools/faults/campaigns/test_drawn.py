"""The plans that campaigns draw for shipped racks: the same seed draws the same plans in every
version, so that a campaign can be repeated."""

from __future__ import annotations

import pytest

from rack.boards.config import load, resolve_layout
from rack.tools.faults.campaigns.draw import RackUnderTest, fault_plans, kill_plans, size_plans
from rack.tools.faults.campaigns.plan import Plan, Targets, needs_real_time, select_kinds
from tests.snapshots import ROOT, Snapshots

SNAPSHOTS = Snapshots(__file__)
RACKS = ("nasrem.toml", "k1607.toml", "hic/hic.toml", "condor/condor.toml", "fig2.toml")
SEED, COUNT, SECONDS = 90251, 3, 14.0


def documents(plans: list[Plan], config: str) -> list[object]:
    """Return plans as a campaign keeps them."""
    return [(plan, plan.format_faults(config)) for plan in plans]


@pytest.mark.parametrize("name", RACKS)
@pytest.mark.parametrize("seed", [SEED, SEED + 1])
def test_the_plans_of_a_seed_are_unchanged(name: str, seed: int) -> None:
    config = load(ROOT / "configs" / name)
    layout = resolve_layout(config)
    targets = Targets(config, layout)
    second = 1e9 / layout.clock_ns
    rack = RackUnderTest(targets, round(SECONDS * second), second, 0.25)
    kinds = select_kinds(None, targets, realtime=True)
    quick = [kind for kind in kinds if not needs_real_time(kind)]
    swept = [kind for kind in quick if kind != "killed from outside"]
    parts: dict[str, object] = {
        "targets": targets.by_kind,
        "kinds": kinds,
        "lockstep": fault_plans(rack, dict.fromkeys(quick, COUNT), str(seed), True, 1),
        "realtime": documents(
            fault_plans(rack, dict.fromkeys(kinds, COUNT), str(seed), False, 7), name
        ),
        "kills": documents([*kill_plans(rack, 7, seed, (True, False), 3)], name),
        "span": (rack.first_tick, rack.first_tick + rack.room_ticks),
    }
    if targets.joints:
        from rack.boards.faults.kind import KINDS

        sized = [kind for kind in swept if kind in KINDS.names]
        parts["sizes"] = documents(size_plans(rack, sized, 4, seed, 2), name)
    SNAPSHOTS.check(f"{name} {seed}", parts)
