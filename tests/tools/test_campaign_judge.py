"""The judge of a campaign, on hand-made faults and events."""

from __future__ import annotations

from dataclasses import replace

import pytest

from boards.events import Event
from tests.tools.campaign_events import LAYOUT, TICK_NS, event, found, strike
from tools.campaign.ending import Strike
from tools.campaign.judge import Judgement, Verdict, judge
from tools.campaign.plan import EXTERNAL

END = event(10_000, "end", "")


def verdict(strikes: list[Strike], *events: Event) -> Verdict:
    return judge(strikes, [*events, END], LAYOUT, offset_ns=0)


def judged(one: Strike, *events: Event) -> Judgement:
    return verdict([one], *events).faults[0]


def test_a_fault_is_detected_by_an_alarm_of_its_kind_about_its_mailbox() -> None:
    fault = judged(strike("mute", "lower", 100, 150), found(107, "mute", "upper", "lower.status"))
    assert (fault.seen, fault.found_by, fault.found_as) == ("detected", "upper", "mute")
    # 2 cycles of the writer and one of the reader.
    assert (fault.delay, fault.bound, fault.is_within) == (7, 2 + 8, True)
    assert fault.delay_ms == 7.5 * 2.5


def test_a_late_detection_is_not_within_the_bound() -> None:
    fault = judged(strike("mute", "lower", 100, 150), found(111, "mute", "upper", "lower.status"))
    assert (fault.seen, fault.delay, fault.is_within) == ("detected", 11, False)


@pytest.mark.parametrize(
    "other",
    [
        found(104, "stale", "upper", "lower.status"),
        found(104, "mute", "lower", "upper.command"),
        found(99, "mute", "upper", "lower.status"),
        event(104, "fault", "begins", "lower", "lower.status"),
    ],
    ids=["another alarm", "another mailbox", "before it struck", "no detection at all"],
)
def test_what_does_not_fit_is_no_detection(other: Event) -> None:
    fault = judged(strike("mute", "lower", 100, 150), other)
    assert (fault.seen, fault.delay, fault.is_within) == ("missed", None, False)


def test_a_fault_without_any_event_is_missed() -> None:
    assert judged(strike("hang", "upper", 100, 200)).seen == "missed"


def test_a_fault_that_never_acted_counts_as_not_struck_whatever_is_found() -> None:
    idle = replace(strike("drop", "lower", 100, 150), tick=-1, count=0)
    fault = judged(idle, found(110, "gap", "upper", "lower.status"))
    assert (fault.seen, fault.is_within) == ("not struck", False)


def test_a_detection_long_after_the_end_of_a_fault_is_of_something_else() -> None:
    late = found(5000, "mute", "upper", "lower.status")
    found_out = verdict([strike("mute", "lower", 100, 150)], late)
    assert found_out.faults[0].seen == "missed"
    assert found_out.unexplained == (late,)


def test_of_two_overlapping_faults_each_has_its_own_detection() -> None:
    both = [strike("corrupt", "lower", 100, 200), strike("mute", "upper", 120, 200, place=1)]
    events = found(103, "damaged", "upper", "lower.status"), found(137, "mute", "lower", "upper.command")
    faults = verdict(both, *events).faults
    assert [(f.kind, f.seen, f.delay) for f in faults] == [("corrupt", "detected", 3), ("mute", "detected", 17)]


def test_one_alarm_is_the_detection_of_one_of_two_equal_faults() -> None:
    both = [strike("corrupt", "lower", 100, 200), strike("corrupt", "lower", 101, 200, place=1)]
    faults = verdict(both, found(103, "damaged", "upper", "lower.status")).faults
    assert [fault.seen for fault in faults] == ["detected", "missed"]
    events = found(103, "damaged", "upper", "lower.status"), found(111, "damaged", "upper", "lower.status")
    assert [fault.seen for fault in verdict(both, *events).faults] == ["detected", "detected"]


def test_a_death_is_bounded_in_time_at_the_rack_and_in_cycles_at_a_neighbour() -> None:
    killed = strike(EXTERNAL, "lower", 100)
    died = Event(100 * TICK_NS + 4_900_000, 101, "died", "lower", "died", "died")
    fault = judged(killed, died)
    assert (fault.found_by, fault.delay_ms, fault.bound_ms, fault.is_within) == ("the Rack", 4.9, 5.0, True)
    # Later than that, the loss must stand on the backplane for the neighbours within four cycles.
    assert judged(killed, Event(100 * TICK_NS + 5_100_000, 102, "died", "lower", "died", "died")).is_within
    late = Event(100 * TICK_NS + 12_600_000, 105, "died", "lower", "died", "died")
    assert not judged(killed, late).is_within
    # 4 cycles of the writer, and one of the reader.
    fault = judged(killed, late, found(112, "stale", "upper", "lower.status"))
    assert (fault.found_by, fault.found_as, fault.delay, fault.bound, fault.is_within) == (
        "upper",
        "stale",
        12,
        12,
        True,
    )


def test_the_death_of_another_board_is_no_detection_and_unexplained() -> None:
    died = event(101, "died", "died", "upper")
    found_out = verdict([strike("kill", "lower", 100)], died)
    assert found_out.faults[0].seen == "missed"
    assert found_out.unexplained == (died,)


def test_ticks_that_the_clock_left_out_are_not_counted() -> None:
    skips = [event(106, "miss", "clock_skipped", board, value=5.0) for board in ("upper", "lower")]
    fault = judged(strike("mute", "lower", 100, 150), *skips, found(115, "mute", "upper", "lower.status"))
    # The two tasks tell of the same five ticks.
    assert (fault.delay, fault.is_within) == (10, True)


def test_a_skip_of_the_clock_is_found_by_the_ticks_that_it_leaves_out() -> None:
    fault = judged(strike("clock-skip", "clock", 100), event(101, "miss", "clock_skipped", "lower", value=1.0))
    assert (fault.seen, fault.delay, fault.bound, fault.is_within) == ("detected", 1, 1, True)


@pytest.mark.parametrize(("subject", "seen"), [("elbow", "detected"), ("wrist", "missed"), ("", "detected")])
def test_a_fault_of_a_joint_is_found_at_that_joint(subject: str, seen: str) -> None:
    fault = judged(
        strike("command-nan", "lower", 100, 110, joint="elbow"), found(100, "command_invalid", "lower", subject)
    )
    assert fault.seen == seen


def test_a_fault_that_must_be_found_in_its_own_cycle_is_late_one_cycle_later() -> None:
    struck = strike("command-nan", "lower", 100, 110)
    assert judged(struck, found(100, "command_invalid", "lower")).is_within
    assert not judged(struck, found(101, "command_invalid", "lower")).is_within


def test_a_small_error_of_a_sensor_need_not_be_found_and_is_not_judged() -> None:
    assert not judged(strike("sensor-bias", "lower", 100, 110, size=1e-4)).is_judged
    assert judged(strike("sensor-bias", "lower", 100, 110, size=1.0)).is_judged


def test_recovery_lasts_until_the_last_reaction_is_undone() -> None:
    events = (
        event(100, "died", "died", "lower"),
        event(100, "reaction", "restart", "lower"),
        event(103, "reaction", "brakes_closed", "lower"),
        event(300, "recovery", "rejoined", "lower"),
        event(340, "recovery", "brakes_opened", "lower"),
    )
    fault = judged(strike("kill", "lower", 100), *events)
    assert (fault.reactions, fault.is_recovered, fault.recovery) == (("restart", "brakes_closed"), True, 240)


def test_brakes_that_closed_for_missed_cycles_are_open_again_when_that_is_told() -> None:
    fault = judged(strike("overrun", "lower", 100), event(104, "reaction", "brakes_closed", "lower", value=3.0))
    assert (fault.reactions, fault.is_recovered, fault.recovery) == (("brakes_closed",), True, 4)
    demanded = judged(strike("command-nan", "lower", 100), event(100, "reaction", "brakes_closed", "lower"))
    assert not demanded.is_recovered


def test_brakes_that_closed_for_missed_cycles_are_no_reaction_to_a_lost_message() -> None:
    stall = event(104, "reaction", "brakes_closed", "lower", value=3.0)
    assert judged(strike("drop", "upper", 100, 110), stall).reactions == ()


def test_a_reaction_long_after_a_fault_is_not_its_own() -> None:
    late = event(5000, "reaction", "brakes_closed", "lower", value=2.0)
    assert judged(strike("command-nan", "lower", 100), late).reactions == ()


def test_a_reaction_that_is_not_undone_is_no_recovery() -> None:
    events = (event(100, "reaction", "restart", "lower"), event(300, "recovery", "rejoined", "upper"))
    fault = judged(strike("kill", "lower", 100), *events)
    assert (fault.is_recovered, fault.recovery) == (False, None)


def test_reactions_behind_the_next_fault_are_of_that_one() -> None:
    both = [strike("command-nan", "lower", 100, 110), strike("kill", "lower", 500, place=1)]
    events = (event(500, "reaction", "restart", "lower"), event(700, "recovery", "rejoined", "lower"))
    first, second = verdict(both, *events).faults
    assert (first.reactions, first.recovery) == ((), None)
    assert (second.reactions, second.recovery) == (("restart",), 200)


def test_a_detection_without_a_fault_is_unexplained_and_a_miss_is_not() -> None:
    false = found(4000, "stale", "upper", "lower.status")
    found_out = verdict([strike("mute", "lower", 100, 150)], false, event(4000, "miss", "late", "clock", "lower"))
    assert found_out.unexplained == (false,)


def test_a_consequence_of_a_fault_is_no_false_trip() -> None:
    consequence = found(110, "stale", "lower", "upper.command")
    assert verdict([strike("kill", "lower", 100)], consequence).unexplained == ()


def test_in_lockstep_a_death_is_bounded_in_ticks_for_the_wall_clock_means_nothing() -> None:
    died = Event(900 * TICK_NS, 99, "died", "lower", "died", "died")
    (fault,) = judge([strike("kill", "lower", 100)], [died, END], LAYOUT, 0, lockstep=True).faults
    # It strikes before its tick is given out: the Rack may see the tick before.
    assert (fault.seen, fault.delay, fault.bound, fault.delay_ms, fault.is_within) == ("detected", 0, 2, None, True)


def test_in_lockstep_a_death_that_the_clock_knows_nothing_of_has_neighbours_for_its_bound() -> None:
    died = Event(900 * TICK_NS, 190, "died", "lower", "died", "died")
    (fault,) = judge([strike(EXTERNAL, "lower", 100)], [died, END], LAYOUT, 0, lockstep=True).faults
    assert (fault.seen, fault.delay, fault.bound, fault.is_within) == ("detected", 90, None, True)


def test_a_fault_too_slight_to_count_explains_its_own_detection_and_no_other() -> None:
    slight = replace(strike("actuator-off", "lower", 100, 150), tick=-1, count=0)
    own, other = found(104, "actuator", "lower", "elbow"), found(104, "sensor_range", "lower", "elbow")
    found_out = verdict([slight], own, other)
    assert found_out.faults[0].seen == "not struck"
    assert found_out.unexplained == (other,)
