"""Random plans of a campaign: repeatable, fit for the rack, and so that each fault can be seen."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from math import ceil
from pathlib import Path
from random import Random
from typing import Any

import pytest

from rack.boards.config import load, wire
from rack.boards.config.faults import fault_mistakes, places
from rack.boards.config.published import publish
from rack.boards.config.schema import RackConfig
from rack.boards.faults.bounds import cycle_ticks
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS
from rack.tools.console.answer import Failure
from rack.tools.faults.campaigns.draw import (
    EPISODE,
    HOLDS_UP_S,
    LEAD_S,
    MOST_FAULTS,
    Card,
    RackUnderTest,
    fault_plans,
    kill_plans,
    size_plans,
    swept_sizes,
)
from rack.tools.faults.campaigns.plan import Kill, Plan, Targets, kinds_for, needs_real_time
from rack.tools.faults.ending import EXTERNAL

BOTH = (True, False)
COUNT = 10
TICKS, SECOND = 11_000, 400.0


@pytest.fixture(scope="module")
def config() -> RackConfig:
    return load("nasrem")


@pytest.fixture(scope="module")
def course(config: RackConfig) -> RackUnderTest:
    return RackUnderTest(Targets(config, wire(config)), TICKS, SECOND, 2.0)


@pytest.fixture(scope="module")
def kinds(course: RackUnderTest) -> list[str]:
    return kinds_for(None, course.targets, realtime=True)


def drawn(course: RackUnderTest, kinds: Sequence[str], seed: str, lockstep: bool) -> list[Plan]:
    fitting = [kind for kind in kinds if not (lockstep and needs_real_time(kind))]
    return fault_plans(course, dict.fromkeys(fitting, COUNT), seed, lockstep, first=1)


def test_a_mailbox_is_silent_for_as_long_as_its_fastest_reader_needs_to_notice(
    course: RackUnderTest,
) -> None:
    # The scene is written in every eighth cycle of its board.
    rng = Random(1)
    cards = [Card.draw(course, "mute", rng) for _ in range(200)]
    assert "servo.scene" in {card.target.mailbox for card in cards}
    for card in cards:
        box = course.targets.layout.mailbox(card.target.mailbox or "")
        assert card.ticks > 2 * box.every + card.target.reader


def test_the_same_seed_draws_the_same_plans(course: RackUnderTest, kinds: list[str]) -> None:
    plans = drawn(course, kinds, "7", True)
    assert plans == drawn(course, kinds, "7", True)
    assert plans != drawn(course, kinds, "8", True)
    assert [plan.number for plan in plans] == list(range(1, len(plans) + 1))


def test_every_plan_fits_its_rack(
    course: RackUnderTest, kinds: list[str], config: RackConfig
) -> None:
    for plan in [*drawn(course, kinds, "3", True), *drawn(course, kinds, "3", False)]:
        planned = plan.config(config, "other")
        assert (
            fault_mistakes(places(planned), planned, publish(planned).levels, course.targets.layout)
            == []
        )
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
    assert set(KINDS.names) - set(kinds) == {"lock-held", "tendon-torn"}


def test_what_needs_real_time_is_no_matter_of_lockstep() -> None:
    assert needs_real_time("hog")
    # How soon a death is seen is a matter of time.
    assert needs_real_time(EXTERNAL)
    assert not needs_real_time("kill")


@pytest.mark.parametrize("lockstep", BOTH)
def test_faults_of_a_trial_follow_each_other_with_time_to_recover(
    course: RackUnderTest, kinds: list[str], lockstep: bool
) -> None:
    plans = drawn(course, kinds, "2", lockstep)
    for plan in plans:
        assert 1 <= len(plan.faults) + len(plan.kills) <= MOST_FAULTS
        ends = [
            (
                t.get("tick", 0),
                t.get("tick", 0) + _lasts(t) + _undone(t["kind"], t["board"], course),
            )
            for t in plan.faults
        ]
        ends += [
            (kill.tick, kill.tick + _undone("kill", kill.board, course)) for kill in plan.kills
        ]
        ends.sort()
        assert all(later[0] > earlier[1] for earlier, later in pairwise(ends))
        # The task ends later for each fault that has stopped the arm.
        stops = 0
        for table in plan.faults:
            assert table.get("tick", 0) <= course.last() + (LEAD_S + stops * HOLDS_UP_S) * SECOND
            stops += KINDS[table["kind"]].where == "arm"
    assert max(len(plan.faults) + len(plan.kills) for plan in plans) > 8


def test_faults_of_the_arm_come_in_as_few_trials_as_they_fit_into(course: RackUnderTest) -> None:
    # No mailbox keeps them apart.
    kinds = [
        kind.name for kind in KINDS if kind.where == "arm" and course.targets.by_kind[kind.name]
    ]
    plans = drawn(course, kinds, "6", True)
    rng = Random("6 lockstep")
    order = [kind for kind in kinds for _ in range(COUNT)]
    rng.shuffle(order)
    took = sum(Card.draw(course, kind, rng).room(course) for kind in order)
    fewest = max(took / (course.last() - course.first()), len(order) / MOST_FAULTS)
    assert len(plans) == ceil(fewest)


def test_a_trial_with_room_left_begins_anywhere_in_the_task(course: RackUnderTest) -> None:
    plans = [
        plan
        for seed in range(40)
        for plan in fault_plans(
            course, {"sensor-nan": 1, "command-nan": 1}, str(seed), True, first=1
        )
    ]
    begins = [plan.first for plan in plans]
    assert len(plans) == 40
    assert min(begins) < 0.2 * TICKS
    assert max(begins) > 0.7 * TICKS
    # One follows the other closely, so that the trial can go on from a late snapshot.
    assert all(plan.faults[1]["tick"] - plan.first < 3 * SECOND for plan in plans)


def _undone(kind: str, board: str, course: RackUnderTest) -> int:
    return KINDS[kind].recovery_ticks(board, course.targets.layout, course.restart_s)


def test_a_mailbox_is_struck_again_only_where_its_readers_would_tell_of_it_again(
    course: RackUnderTest,
) -> None:
    layout, again = course.targets.layout, 0
    for plan in fault_plans(
        course, dict.fromkeys(("drop", "corrupt", "delay", "mute"), 100), "5", True, first=1
    ):
        quiet_from: dict[str, int] = {}
        for table in plan.faults:
            box = layout.mailbox(table["mailbox"])
            cycle = cycle_ticks(layout, box.writer)
            slowest = max(cycle, min(cycle_ticks(layout, reader) for reader in box.readers))
            if box.name in quiet_from:
                again += 1
                assert table["tick"] - quiet_from[box.name] >= EPISODE * slowest
            quiet_from[box.name] = table["tick"] + _lasts(table) + int(table.get("by", 0)) * cycle
    assert again > 0


def _lasts(table: Mapping[str, Any]) -> int:
    # A hang ends when it is found.
    return 0 if table["kind"] == "hang" else round(table.get("for", 0.0) * SECOND)


def test_a_board_that_fails_its_start_has_a_trial_of_its_own(
    course: RackUnderTest, kinds: list[str]
) -> None:
    plans = [
        p
        for p in drawn(course, kinds, "2", True)
        if any(t["kind"] == "self-test" for t in p.faults)
    ]
    assert plans
    assert all(len(plan.faults) == 1 and not plan.kills for plan in plans)


def test_faults_strike_at_phases_of_the_tick_in_real_time_alone(
    course: RackUnderTest, kinds: list[str]
) -> None:
    plans = [*drawn(course, kinds, "2", True), *drawn(course, kinds, "2", False)]
    phased = [
        table for plan in plans if not plan.lockstep for table in plan.faults if "phase" in table
    ]
    assert len({table["phase"] for table in phased}) > 5
    assert all(KINDS[table["kind"]].within_tick for table in phased)
    assert not [
        table for plan in plans if plan.lockstep for table in plan.faults if "phase" in table
    ]


def test_only_mailboxes_that_somebody_reads_are_struck(small: Path) -> None:
    counting = load(small)
    targets = Targets(counting, wire(counting))
    struck = {
        target.mailbox for found in targets.by_kind.values() for target in found if target.mailbox
    }
    # Nobody reads upper.status; lower.plan is of a planner, and no periodic message.
    assert {target.mailbox for target in targets.by_kind["mute"]} == {
        "upper.command",
        "lower.status",
    }
    assert struck == {"upper.command", "lower.status", "lower.plan"}


def test_a_muted_mailbox_stays_mute_for_longer_than_its_bound(course: RackUnderTest) -> None:
    layout = course.targets.layout
    for plan in drawn(course, ["mute"], "4", True):
        for table in plan.faults:
            readers = layout.mailbox(table["mailbox"]).readers
            bound = 2 * cycle_ticks(layout, table["board"]) + min(
                cycle_ticks(layout, r) for r in readers
            )
            assert table["for"] * SECOND >= bound


def test_kills_from_outside_are_as_many_as_asked_for_and_apart(course: RackUnderTest) -> None:
    plans = list(kill_plans(course, 50, 5, BOTH, first=4))
    assert sum(len(plan.kills) for plan in plans) == 50
    assert [plan.number for plan in plans] == list(range(4, 4 + len(plans)))
    assert {plan.lockstep for plan in plans} == {True, False}
    assert {kill.board for plan in plans for kill in plan.kills} == {
        *(task.name for task in course.targets.layout.tasks),
        "clock",
    }
    for plan in plans:
        ticks = [kill.tick for kill in plan.kills]
        assert all(later - earlier >= 3.5 * SECOND for earlier, later in pairwise(ticks))


def test_every_size_of_the_sweep_comes_once(course: RackUnderTest, kinds: list[str]) -> None:
    plans = list(size_plans(course, kinds, 10, 6, first=1))
    found = Counter((table["kind"], table["size"]) for plan in plans for table in plan.faults)
    assert found == Counter({(kind, size): 1 for kind in kinds for size in swept_sizes(kind, 10)})


def test_a_plan_is_a_file_that_repeats_it(config: RackConfig, tmp_path: Path) -> None:
    fault = {
        "kind": "drop",
        "board": "servo",
        "tick": 7,
        "for": 0.05,
        "mailbox": "servo.status",
        "probability": 0.5,
    }
    plan = Plan(3, "faults", lockstep=True, faults=(fault,), kills=(Kill("task", 90, 0.25),))
    text = plan.toml("nasrem")
    assert "rack run nasrem --lockstep --faults" in text
    assert "# external kill: task at tick 90 + 0.25" in text
    tables = tomllib.loads(text)["fault"]
    assert (
        tuple(FaultConfig.model_validate(table) for table in tables)
        == plan.config(config, "other").fault
    )


@pytest.mark.parametrize(
    ("wanted", "lockstep", "why"),
    [
        ("kill,murder", False, "--kinds murder: no such kind; kinds: kill, hang, "),
        ("lock-held", False, "--kinds lock-held: nothing in this rack can have it; kinds: "),
        ("hog", True, "--kinds hog: hog needs real time, and the campaign is in lockstep; kinds: "),
        (" , ", False, "--kinds: names no kind; kinds: "),
    ],
)
def test_a_kind_that_cannot_be_is_refused_in_one_line(
    course: RackUnderTest, wanted: str, lockstep: bool, why: str
) -> None:
    with pytest.raises(Failure) as refused:
        kinds_for(wanted, course.targets, realtime=not lockstep)
    assert refused.value.status == 2
    assert str(refused.value).startswith(why)
    assert "\n" not in str(refused.value)
