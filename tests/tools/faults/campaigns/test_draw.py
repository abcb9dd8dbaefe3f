"""Random plans of a campaign: repeatable, fit for the rack, and so that each fault can be seen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import pytest

from rack.boards.config import load, resolve_layout
from rack.boards.config.injections import find_fault_mistakes, list_faults
from rack.boards.config.published import gather_facts
from rack.boards.config.schema import RackConfig
from rack.boards.faults.bounds import cycle_ticks
from rack.boards.faults.kind import KINDS
from rack.tools.faults.campaigns.draw import (
    ARM_STOP_S,
    EPISODE_READS,
    LEAD_S,
    MAX_FAULTS,
    RackUnderTest,
    fault_plans,
    size_plans,
)
from rack.tools.faults.campaigns.plan import Plan, Targets, needs_real_time, select_kinds
from rack.tools.faults.ending import EXTERNAL
from tests.tools.command_line import read_failure

BOTH = (True, False)
COUNT = 10
TICKS, SECOND = 11_000, 400.0


@pytest.fixture(scope="module")
def config() -> RackConfig:
    return load("nasrem")


@pytest.fixture(scope="module")
def course(config: RackConfig) -> RackUnderTest:
    return RackUnderTest(Targets(config, resolve_layout(config)), TICKS, SECOND, 2.0)


@pytest.fixture(scope="module")
def kinds(course: RackUnderTest) -> list[str]:
    return select_kinds(None, course.targets, realtime=True)


def drawn(course: RackUnderTest, kinds: Sequence[str], seed: str, lockstep: bool) -> list[Plan]:
    fitting = [kind for kind in kinds if not (lockstep and needs_real_time(kind))]
    return fault_plans(course, dict.fromkeys(fitting, COUNT), seed, lockstep, first=1)


def test_every_plan_fits_its_rack(
    course: RackUnderTest, kinds: list[str], config: RackConfig
) -> None:
    for plan in [*drawn(course, kinds, "3", True), *drawn(course, kinds, "3", False)]:
        planned = plan.to_config(config, "other")
        levels, layout = gather_facts(planned).levels, course.targets.layout
        assert find_fault_mistakes(list_faults(planned), planned, levels, layout) == []
    assert size_plans(course, kinds, 10, 3, 61)[0].number == 61


@pytest.mark.parametrize("lockstep", BOTH)
def test_every_kind_is_drawn_as_often_as_asked_for(
    course: RackUnderTest, kinds: list[str], lockstep: bool
) -> None:
    plans = drawn(course, kinds, "1", lockstep)
    found = Counter(table["kind"] for plan in plans for table in plan.faults)
    found[EXTERNAL] += sum(len(plan.kills) for plan in plans)
    wanted = [kind for kind in kinds if not (lockstep and needs_real_time(kind))]
    assert +found == Counter(dict.fromkeys(wanted, COUNT))
    # Nothing of the default rack has protocol lock, or tendons.
    assert set(KINDS.names) - set(kinds) == {"lock-held", "tendon-torn", "wrong-output"}


@pytest.mark.parametrize("lockstep", BOTH)
def test_faults_of_a_trial_follow_each_other_with_time_to_recover(
    course: RackUnderTest, kinds: list[str], lockstep: bool
) -> None:
    plans = drawn(course, kinds, "2", lockstep)
    for plan in plans:
        assert 1 <= len(plan.faults) + len(plan.kills) <= MAX_FAULTS
        faults = [(t.get("tick", 0), t["kind"], t["board"], _lasts(t)) for t in plan.faults]
        faults += [(kill.tick, "kill", kill.board, 0) for kill in plan.kills]
        for (tick, kind, board, lasts), later in pairwise(sorted(faults)):
            layout = course.targets.layout
            undone = KINDS[kind].compute_recovery_ticks(board, layout, course.restart_s)
            assert later[0] > tick + lasts + undone
        # The task ends later for each fault that has stopped the arm.
        stops = 0
        for table in plan.faults:
            assert (
                table.get("tick", 0)
                <= course.first_tick + course.room_ticks + (LEAD_S + stops * ARM_STOP_S) * SECOND
            )
            stops += KINDS[table["kind"]].where == "arm"
    assert max(len(plan.faults) + len(plan.kills) for plan in plans) > 8


def test_a_mailbox_is_affected_again_only_if_its_readers_would_report_it(
    course: RackUnderTest,
) -> None:
    layout, again = course.targets.layout, 0
    for plan in fault_plans(
        course, dict.fromkeys(("drop", "corrupt", "delay", "mute"), 100), "5", True, first=1
    ):
        quiet_from: dict[str, int] = {}
        for table in plan.faults:
            box = layout.find_mailbox(table["mailbox"])
            cycle = cycle_ticks(layout, box.writer)
            slowest = max(cycle, min(cycle_ticks(layout, reader) for reader in box.readers))
            if box.name in quiet_from:
                again += 1
                assert table["tick"] - quiet_from[box.name] >= EPISODE_READS * slowest
            quiet_from[box.name] = table["tick"] + _lasts(table) + int(table.get("by", 0)) * cycle
    assert again > 0


def _lasts(table: Mapping[str, Any]) -> int:
    # A hang ends when it is found.
    return 0 if table["kind"] == "hang" else round(table.get("for", 0.0) * SECOND)


@pytest.mark.parametrize(
    ("wanted", "lockstep", "why"),
    [
        ("kill,murder", False, "murder: there is no such kind; valid kinds: kill, hang, "),
        ("lock-held", False, "lock-held: nothing in this rack can have it; valid kinds: "),
        ("clock-stop", True, "clock-stop: clock-stop needs real time, and the campaign is in"),
        (" , ", False, "names no kind; valid kinds: "),
    ],
)
def test_an_impossible_kind_is_refused_in_one_line(
    course: RackUnderTest, wanted: str, lockstep: bool, why: str
) -> None:
    refusal = read_failure(select_kinds, wanted, course.targets, not lockstep)
    assert refusal.startswith(f"--kinds {why}")
