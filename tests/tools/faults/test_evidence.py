"""Events as evidence: which can be the detection of a fault, what explains what, and what undoes a
reaction."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.boards.events import Event
from rack.boards.faults.kind import DIED
from rack.tools.faults.ending import Strike
from rack.tools.faults.evidence import (
    Aftermath,
    Detection,
    SkippedTicks,
    aftermath,
    explains,
    fits,
    is_about,
    takes_cycles,
)
from tests.tools.fault_events import event, flows, found, strike

MUTE = strike("mute", "lower", 100, 150)
KILL = strike("kill", "lower", 100)
LATE = strike("overrun", "lower", 100, 150)
BIAS = replace(strike("sensor-bias", "lower", 100, 150), joint="j2")
SKIP = strike("clock-skip", "clock", 100)


@pytest.mark.parametrize(
    ("struck", "seen", "can_be"),
    [
        (MUTE, found(100, "mute", "upper", "lower.status"), True),
        (MUTE, found(99, "mute", "upper", "lower.status"), False),
        (MUTE, found(100, "mute", "upper", "upper.command"), False),
        (MUTE, found(100, "gap", "upper", "lower.status"), False),
        (MUTE, event(100, "reaction", "mute", "upper", "lower.status"), False),
        (replace(MUTE, tick=-1), found(100, "mute", "upper", "lower.status"), False),
        # A process that reads the tick may see the one before.
        (KILL, event(99, "died", DIED, "lower"), True),
        (KILL, event(98, "died", DIED, "lower"), False),
        (KILL, event(100, "died", DIED, "upper"), False),
        (LATE, event(101, "miss", "late", "lower", "lower"), True),
        (LATE, event(101, "miss", "late", "upper", "upper"), False),
        (SKIP, event(101, "miss", "clock_skipped", "upper"), True),
        (BIAS, found(101, "sensor_jump", "lower", "j2"), True),
        (BIAS, found(101, "sensor_jump", "lower", "j1"), False),
        (BIAS, found(101, "sensor_jump", "lower", "all joints"), True),
        (BIAS, found(101, "sensor_jump", "lower", ""), True),
        (replace(BIAS, joint=""), found(101, "sensor_jump", "lower", "j1"), True),
    ],
)
def test_a_detection_is_of_the_faults_kind_about_its_target_and_not_before_it(
    struck: Strike, seen: Event, can_be: bool
) -> None:
    if seen.code == "sensor_jump":
        seen = replace(seen, code=next(iter(sorted(struck.record.codes))))
    assert fits(seen, struck) is can_be


def test_an_alarm_of_the_clock_is_about_the_clock_alone() -> None:
    seen = event(101, "miss", "clock_skipped", "upper")
    assert is_about(seen, SKIP)
    assert not is_about(seen, LATE)


def test_what_takes_cycles_explains_misses_of_any_task() -> None:
    miss = event(120, "miss", "late", "upper", "upper")
    assert [takes_cycles(struck) for struck in (KILL, LATE, SKIP, MUTE, BIAS)] == [
        True,
        True,
        True,
        False,
        False,
    ]
    assert [explains(struck, miss) for struck in (LATE, MUTE)] == [True, False]


def test_a_fault_that_ends_processes_explains_the_death_of_its_own_board() -> None:
    died = event(120, "died", DIED, "lower")
    assert explains(KILL, died)
    assert not explains(KILL, replace(died, board="upper"))
    assert not explains(MUTE, died)


SKIPS = SkippedTicks(
    [
        replace(event(10, "miss", "clock_skipped", "a"), value=2.0),
        replace(event(20, "miss", "clock_skipped", "a"), value=3.0),
        replace(event(20, "miss", "clock_skipped", "b"), value=4.0),
        replace(event(20, "detection", "clock_skipped", "c"), value=90.0),
        replace(event(20, "miss", "late", "d"), value=90.0),
    ]
)


@pytest.mark.parametrize(
    ("first", "last", "skipped"),
    [
        (0, 100, 5),
        (9, 10, 1),
        (8, 10, 2),
        (10, 19, 0),
        (10, 20, 4),
        (0, 9, 0),
        (100, 0, 0),
        (17, 20, 3),
    ],
)
def test_skipped_ticks_are_those_that_one_task_has_missed_and_no_more_than_there_were(
    first: int, last: int, skipped: int
) -> None:
    assert SKIPS.between(first, last) == skipped


@pytest.mark.parametrize(
    ("detection", "is_within"),
    [
        (Detection(found(1, "a", "b"), 5, None), True),
        (Detection(found(1, "a", "b"), 5, 5), True),
        (Detection(found(1, "a", "b"), 6, 5), False),
        # The bound of a death in real time is the only one.
        (Detection(found(1, "a", "b"), 6, 5, 10.0, 10.0), True),
        (Detection(found(1, "a", "b"), 4, 5, 10.1, 10.0), False),
        (Detection(found(1, "a", "b"), 4, 5, None, 10.0), True),
    ],
)
def test_a_detection_is_within_its_bound(detection: Detection, is_within: bool) -> None:
    assert detection.is_within is is_within


def test_the_best_detection_is_within_its_bound_then_early() -> None:
    seen = found(1, "a", "b")
    late = Detection(seen, 2, 1)
    slow = Detection(seen, 9, 10, 3.0)
    early = Detection(seen, 4, 10, 3.0)
    earliest = Detection(seen, 4, 10, 1.0)
    assert sorted([late, slow, early, earliest], key=lambda one: one.order) == [
        earliest,
        early,
        slow,
        late,
    ]


def test_of_detections_in_the_same_tick_the_tightest_bound_counts_then_the_board() -> None:
    tight = Detection(found(1, "a", "c"), 4, 9)
    by_name = Detection(found(1, "a", "b"), 4, 16)
    later_name = Detection(found(1, "a", "c"), 4, 16)
    unbound = Detection(found(1, "a", "a"), 4, None)
    found_by = sorted([later_name, unbound, by_name, tight], key=lambda one: one.order)
    assert found_by == [tight, by_name, later_name, unbound]


RESTART = event(105, "reaction", "restart", "lower")
REJOINED = event(130, "recovery", "rejoined", "lower")


def test_reactions_are_undone_by_their_own_recoveries() -> None:
    assert aftermath(KILL, [RESTART], 500, ()) == Aftermath(("restart",), False, None, ())
    other = replace(REJOINED, board="upper")
    early = replace(REJOINED, tick=104)
    assert not aftermath(KILL, [RESTART, other, early], 500, ()).is_undone
    done = aftermath(KILL, [RESTART, REJOINED, replace(REJOINED, tick=140)], 500, ())
    assert done == Aftermath(("restart",), True, 30, ())
    # Not to it: before it, or from the horizon on. A board that is killed must be restarted.
    nothing = Aftermath((), True, None, ("restart",))
    assert aftermath(KILL, [replace(RESTART, tick=99)], 500, ()) == nothing
    assert aftermath(KILL, [RESTART], 105, ()) == nothing
    assert aftermath(replace(KILL, tick=-1), [RESTART], 500, ()) == Aftermath()


def test_messages_that_are_owed_must_flow_after_the_fault() -> None:
    owed = ["lower.status"]
    assert not aftermath(MUTE, [flows(149)], 500, owed).is_undone
    assert aftermath(MUTE, [flows(150)], 500, owed).recovery == 50
    assert aftermath(MUTE, [flows(160), flows(155)], 500, owed).recovery == 60
    assert aftermath(MUTE, [flows(160, "upper.command")], 500, owed).recovery is None


def test_brakes_in_the_tick_of_a_collision_are_no_reaction_to_a_fault() -> None:
    brakes = event(110, "reaction", "brakes_closed", "lower")
    opened = event(140, "recovery", "brakes_opened", "lower")
    assert aftermath(MUTE, [brakes, opened], 500, ()).reactions == ("brakes_closed",)
    hit = found(110, "collision", "lower")
    assert aftermath(MUTE, [hit, brakes, opened], 500, ()).reactions == ()
    # For missed cycles they are a reaction to what takes cycles alone, and over when released.
    missed = replace(brakes, value=2.0)
    assert aftermath(MUTE, [missed], 500, ()).reactions == ()
    both = [missed, opened]
    assert aftermath(LATE, both, 500, ()) == Aftermath(("brakes_closed",), True, 40, ())
    assert not aftermath(LATE, [missed], 500, ()).is_undone


def test_a_reaction_that_must_follow_is_lacking_unless_the_brakes_were_engaged_before() -> None:
    nan = strike("command-nan", "lower", 100, 110)
    assert aftermath(nan, [], 500, ()).lacking == ("brakes_closed",)
    closed = event(90, "reaction", "brakes_closed", "lower")
    assert aftermath(nan, [closed], 500, ()).lacking == ()
    opened = event(100, "recovery", "brakes_opened", "lower")
    assert aftermath(nan, [closed, opened], 500, ()).lacking == ("brakes_closed",)
    assert aftermath(nan, [closed, replace(opened, tick=101)], 500, ()).lacking == ()
