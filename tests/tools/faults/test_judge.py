"""The judge of faults, on hand-made faults and events."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest

from rack.backplane.fault_table import NEVER
from rack.boards.events import Event
from rack.tools.faults.ending import EXTERNAL, Strike
from rack.tools.faults.judge import Circumstances, FaultVerdict, Judgement, faults, judge
from tests.tools.fault_events import LAYOUT, TICK_NS, box, event, flows, found, strike

END = event(10_000, "end", "")


REAL_TIME = Circumstances(LAYOUT, offset_ns=0)
LOCKSTEP = replace(REAL_TIME, is_lockstep=True)


def verdict(strikes: list[Strike], *events: Event, run: Circumstances = REAL_TIME) -> FaultVerdict:
    return judge(strikes, [*events, END], run)


def judged(one: Strike, *events: Event, run: Circumstances = REAL_TIME) -> Judgement:
    return verdict([one], *events, run=run).faults[0]


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
    events = (
        found(103, "damaged", "upper", "lower.status"),
        found(137, "mute", "lower", "upper.command"),
    )
    faults = verdict(both, *events).faults
    assert [(f.kind, f.seen, f.delay) for f in faults] == [
        ("corrupt", "detected", 3),
        ("mute", "detected", 17),
    ]


def test_one_alarm_is_the_detection_of_one_of_two_equal_faults() -> None:
    both = [strike("corrupt", "lower", 100, 200), strike("corrupt", "lower", 101, 200, place=1)]
    faults = verdict(both, found(103, "damaged", "upper", "lower.status")).faults
    assert [fault.seen for fault in faults] == ["detected", "missed"]
    events = (
        found(103, "damaged", "upper", "lower.status"),
        found(111, "damaged", "upper", "lower.status"),
    )
    assert [fault.seen for fault in verdict(both, *events).faults] == ["detected", "detected"]


@pytest.mark.parametrize("kind", ["kill", EXTERNAL])
def test_a_death_that_the_rack_finds_late_is_late_whatever_its_neighbours_find(kind: str) -> None:
    killed, stale = strike(kind, "lower", 100), found(104, "stale", "upper", "lower.status")
    died = Event(100 * TICK_NS + 49_900_000, 101, "died", "lower", "died", "died")
    fault = judged(killed, stale, died)
    assert (fault.found_by, fault.delay_ms, fault.bound_ms, fault.is_within) == (
        "the Rack",
        49.9,
        50.0,
        True,
    )
    late = replace(died, time_ns=100 * TICK_NS + 50_100_000)
    assert not judged(killed, stale, late).is_within
    # Nobody but the Rack has noticed: that is no detection of a death.
    assert judged(killed, stale).seen == "missed"


def test_the_death_of_another_board_is_no_detection_and_unexplained() -> None:
    died = event(101, "died", "died", "upper")
    found_out = verdict([strike("kill", "lower", 100)], died)
    assert found_out.faults[0].seen == "missed"
    assert found_out.unexplained == (died,)


def test_ticks_that_the_clock_left_out_are_not_counted() -> None:
    skips = [event(106, "miss", "clock_skipped", board, value=5.0) for board in ("upper", "lower")]
    fault = judged(
        strike("mute", "lower", 100, 150), *skips, found(115, "mute", "upper", "lower.status")
    )
    # The two tasks tell of the same five ticks.
    assert (fault.delay, fault.is_within) == (10, True)


def test_a_skip_of_the_clock_is_found_by_the_ticks_that_it_leaves_out() -> None:
    fault = judged(
        strike("clock-skip", "clock", 100), event(101, "miss", "clock_skipped", "lower", value=1.0)
    )
    assert (fault.seen, fault.delay, fault.bound, fault.is_within) == ("detected", 1, 1, True)


@pytest.mark.parametrize(
    ("subject", "seen"), [("elbow", "detected"), ("wrist", "missed"), ("", "detected")]
)
def test_a_fault_of_a_joint_is_found_at_that_joint(subject: str, seen: str) -> None:
    fault = judged(
        strike("command-nan", "lower", 100, 110, joint="elbow"),
        found(100, "command_invalid", "lower", subject),
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
    assert (fault.reactions, fault.is_recovered, fault.recovery) == (
        ("restart", "brakes_closed"),
        True,
        240,
    )


def test_brakes_that_closed_for_missed_cycles_are_recovered_from_when_they_open() -> None:
    closed = event(104, "reaction", "brakes_closed", "lower", value=3.0)
    opened = event(107, "recovery", "brakes_opened", "lower")
    fault = judged(strike("overrun", "lower", 100), closed, opened)
    assert (fault.reactions, fault.is_recovered, fault.recovery) == (("brakes_closed",), True, 7)
    demanded = judged(
        strike("sensor-nan", "lower", 100), event(100, "reaction", "brakes_closed", "lower")
    )
    assert not demanded.is_recovered


def test_brakes_that_closed_for_missed_cycles_are_no_reaction_to_a_lost_message() -> None:
    stall = event(104, "reaction", "brakes_closed", "lower", value=3.0)
    assert judged(strike("drop", "upper", 100, 110), stall).reactions == ()


def test_a_reaction_long_after_a_fault_is_not_its_own() -> None:
    late = event(5000, "reaction", "brakes_closed", "lower", value=2.0)
    assert judged(strike("command-nan", "lower", 100), late).reactions == ()


def test_a_reaction_that_is_not_undone_is_no_recovery() -> None:
    events = (
        event(100, "reaction", "restart", "lower"),
        event(300, "recovery", "rejoined", "upper"),
    )
    fault = judged(strike("kill", "lower", 100), *events)
    assert (fault.is_recovered, fault.recovery) == (False, None)


def test_reactions_behind_the_next_fault_are_of_that_one() -> None:
    both = [strike("command-nan", "lower", 100, 110), strike("kill", "lower", 500, place=1)]
    events = (
        event(500, "reaction", "restart", "lower"),
        event(700, "recovery", "rejoined", "lower"),
    )
    first, second = verdict(both, *events).faults
    assert (first.reactions, first.recovery) == ((), None)
    assert (second.reactions, second.recovery) == (("restart",), 200)


def test_a_detection_without_a_fault_is_unexplained_and_a_miss_is_not() -> None:
    false = found(4000, "stale", "upper", "lower.status")
    found_out = verdict(
        [strike("mute", "lower", 100, 150)], false, event(4000, "miss", "late", "clock", "lower")
    )
    assert found_out.unexplained == (false,)


def test_a_consequence_of_a_fault_is_no_false_trip() -> None:
    consequence = found(110, "stale", "upper", "lower.status")
    assert verdict([strike("kill", "lower", 100)], consequence).unexplained == ()


@pytest.mark.parametrize(
    "other",
    [
        found(110, "stale", "lower", "upper.command"),
        found(110, "damaged", "upper", "lower.status"),
        found(110, "sensor_nan", "lower", "elbow"),
        found(110, "hang", "clock", "upper"),
        event(110, "died", "died", "upper"),
    ],
    ids=["another mailbox", "another alarm", "the arm", "another task", "another board"],
)
def test_a_fault_explains_what_its_kind_leads_to_and_nothing_else(other: Event) -> None:
    assert verdict([strike("kill", "lower", 100)], other).unexplained == (other,)


def test_a_fault_explains_nothing_after_its_window() -> None:
    # Its bound, a cycle and two seconds and a quarter for a restart, the last message's way, a
    # quarter of a second.
    late = found(100 + 2 + 1 + 900 + (1 + 8) + 100 + 1, "stale", "upper", "lower.status")
    in_time = replace(late, tick=late.tick - 1)
    assert verdict([strike("kill", "lower", 100)], late).unexplained == (late,)
    assert verdict([strike("kill", "lower", 100)], in_time).unexplained == ()


def test_what_a_task_finds_has_the_tick_of_its_release_which_may_be_before_the_fault() -> None:
    in_slice, before = (
        found(97, "masquerade", "lower.planner", "lower.status"),
        found(90, "masquerade", "upper", ""),
    )
    early = replace(in_slice, tick=94)
    forged = strike("masquerade", "lower", 100)
    assert verdict([forged], in_slice).unexplained == ()
    assert verdict([forged], early, before).unexplained == (early, before)


def test_a_sensor_at_fault_may_show_at_any_joint_but_is_found_only_at_its_own() -> None:
    other = found(101, "sensor_model", "lower", "wrist")
    found_out = verdict([strike("sensor-bias", "lower", 100, 110, joint="elbow", size=1.0)], other)
    assert (found_out.faults[0].seen, found_out.unexplained) == ("missed", ())


def test_a_reaction_that_a_kind_must_have_and_that_does_not_come_is_lacking() -> None:
    died = event(101, "died", "died", "lower")
    assert judged(strike("kill", "lower", 100), died).lacking == ("restart",)
    assert judged(strike("command-nan", "lower", 100, 110)).lacking == ("brakes_closed",)
    assert judged(strike("mute", "lower", 100, 110)).lacking == ()


@pytest.mark.parametrize(("opened", "recovered"), [(110 + 100, True), (110 + 101, False)])
def test_what_was_done_must_be_undone_within_the_bound_of_the_kind(
    opened: int, recovered: bool
) -> None:
    events = (
        found(100, "command_invalid", "lower"),
        event(100, "reaction", "brakes_closed", "lower"),
        event(opened, "recovery", "brakes_opened", "lower"),
    )
    # A quarter of a second after the end of the fault.
    fault = judged(strike("command-nan", "lower", 100, 110), *events)
    assert (fault.is_recovered, fault.recovery_bound) == (recovered, 110)


def test_a_fault_that_may_be_latched_is_recovered_from_when_it_is_and_the_task_ends_with_it() -> (
    None
):
    events = (
        event(100, "reaction", "brakes_closed", "lower"),
        event(900, "reaction", "latched", "lower"),
    )
    stuck = strike("sensor-stuck", "lower", 100, 2000, count=1900)
    failed = judged(stuck, *events, run=replace(REAL_TIME, has_failed=True))
    assert (failed.is_latched, failed.is_recovered) == (True, True)
    assert not judged(stuck, *events).is_recovered
    # A rack that just waits has not latched anything.
    assert not judged(stuck, events[0], run=replace(REAL_TIME, has_failed=True)).is_recovered
    assert not judged(strike("command-nan", "lower", 100, 2000), *events).is_recovered


def test_an_obstacle_that_moves_may_meet_an_arm_that_a_fault_has_kept_and_nothing_else_may() -> (
    None
):
    hit = replace(
        found(300, "collision", "lower", "arm"), text="unintended contact: 'arm' touches 'post'"
    )
    events = (
        event(100, "reaction", "brakes_closed", "lower"),
        event(110, "recovery", "brakes_opened", "lower"),
        hit,
        event(300, "reaction", "brakes_closed", "lower"),
    )
    off = strike("actuator-off", "lower", 100, 110, count=9)
    in_the_way = verdict([off], *events, run=replace(REAL_TIME, moving=("post",)))
    assert in_the_way.unexplained == ()
    # The brakes that it brings on are no reaction to the motor.
    assert in_the_way.faults[0].recovery == 10
    assert verdict([off], *events, run=replace(REAL_TIME, moving=("door",))).unexplained == (hit,)
    after = replace(off, tick=301, began=301, ends=310)
    assert verdict([after], *events, run=replace(REAL_TIME, moving=("post",))).unexplained == (hit,)


def test_a_run_that_ends_before_the_bound_of_a_recovery_says_nothing_about_it() -> None:
    events = (
        found(100, "command_invalid", "lower"),
        event(100, "reaction", "brakes_closed", "lower"),
    )
    nan = strike("command-nan", "lower", 100, 110)
    assert judge([nan], [*events, event(209, "end", "")], REAL_TIME).faults[0].is_recovered
    assert not judge([nan], [*events, event(210, "end", "")], REAL_TIME).faults[0].is_recovered


def test_what_is_latched_is_no_reaction_to_a_fault_that_cannot_be() -> None:
    muted = judged(
        strike("mute", "lower", 100, 150), event(110, "reaction", "latched", "lower"), flows(152)
    )
    assert (muted.reactions, muted.is_recovered) == ((), True)


@pytest.mark.parametrize(
    ("seen", "recovered", "after"),
    [
        ([], False, None),
        ([flows(149)], False, None),
        ([flows(152, "upper.command")], False, None),
        ([flows(152)], True, 52),
        ([flows(149), flows(252)], True, 152),
        ([flows(253)], False, 153),
    ],
    ids=["never", "before its end", "another mailbox", "soon", "in time", "too late"],
)
def test_struck_messages_are_recovered_from_when_they_flow_again(
    seen: list[Event], recovered: bool, after: int | None
) -> None:
    # A message is due a tick after the end, and read a tick later; then a quarter of a second.
    fault = judged(
        strike("mute", "lower", 100, 150), found(107, "mute", "upper", "lower.status"), *seen
    )
    assert (fault.seen, fault.is_recovered, fault.recovery, fault.recovery_bound) == (
        *("detected", recovered, after),
        50 + 1 + 1 + 100,
    )


def test_nothing_recovers_from_a_fault_of_messages_without_an_end() -> None:
    silent, mute = strike("mute", "lower", 100, NEVER), found(107, "mute", "upper", "lower.status")
    fault = judge([silent], [flows(99), mute, event(200, "end", "")], REAL_TIME).faults[0]
    assert (fault.seen, fault.struck, fault.is_recovered) == ("detected", 100, False)
    # One that was to end says nothing yet.
    assert (
        judge([replace(silent, ends=900)], [mute, event(200, "end", "")], REAL_TIME).faults[0].seen
        == "not struck"
    )


def test_a_plan_is_recovered_from_whenever_the_next_one_comes_and_undecided_without_one() -> None:
    layout = replace(
        LAYOUT, mailboxes=(*LAYOUT.mailboxes, box("lower.plan", "lower.planner", "lower", 4))
    )
    forged = replace(strike("masquerade", "lower.planner", 100), mailboxes=("lower.plan",))
    run = Circumstances(layout, offset_ns=0)
    late = verdict([forged], flows(9000, "lower.plan"), run=run).faults[0]
    assert (late.is_recovered, late.recovery) == (True, 8900)
    assert verdict([forged], run=run).faults[0].seen == "not struck"


@pytest.mark.parametrize(("tick", "within"), [(118, True), (127, True), (128, False)])
def test_the_delay_of_a_fault_counts_from_its_strike_and_its_bound_from_when_it_shows(
    tick: int, within: bool
) -> None:
    weak = replace(strike("actuator-saturated", "lower", 100, 150), hidden=15, count=30)
    fault = judged(weak, found(tick, "actuator", "lower", "elbow"))
    assert (fault.struck, fault.delay, fault.bound, fault.is_within) == (
        100,
        tick - 100,
        15 + 12,
        within,
    )


def test_misses_that_no_fault_explains_are_counted_apart_from_detections() -> None:
    miss = event(105, "miss", "late", "clock", "upper")
    assert verdict([strike("mute", "lower", 100, 150)], miss).misses == (miss,)
    assert verdict([strike("overrun", "lower", 100, 150)], miss).misses == ()
    assert verdict([strike("overrun", "lower", 100, 150)], replace(miss, tick=5000)).misses != ()


def test_in_lockstep_a_death_is_bounded_in_ticks_for_the_wall_clock_means_nothing() -> None:
    died = Event(900 * TICK_NS, 99, "died", "lower", "died", "died")
    fault = judged(strike("kill", "lower", 100), died, run=LOCKSTEP)
    # It strikes before its tick is given out: the Rack may see the tick before.
    assert (fault.seen, fault.delay, fault.bound, fault.delay_ms, fault.is_within) == (
        "detected",
        0,
        2,
        None,
        True,
    )


def test_in_lockstep_a_death_that_the_clock_knows_nothing_of_has_neighbours_for_its_bound() -> None:
    died = Event(900 * TICK_NS, 190, "died", "lower", "died", "died")
    fault = judged(strike(EXTERNAL, "lower", 100), died, run=LOCKSTEP)
    assert (fault.seen, fault.delay, fault.bound, fault.is_within) == ("detected", 90, None, True)


def test_brakes_that_are_engaged_when_a_fault_strikes_need_not_be_engaged_for_it() -> None:
    torque = strike("command-limit", "lower", 100, 110, joint="elbow")
    refused = found(100, "command_limit", "lower", "elbow")
    engaged, released = (
        event(60, "reaction", "brakes_closed"),
        event(110, "recovery", "brakes_opened"),
    )
    assert judged(torque, refused, engaged, released).lacking == ()
    assert judged(torque, refused, engaged, replace(released, tick=99)).lacking == (
        "brakes_closed",
    )


def test_what_is_too_late_for_one_fault_and_in_time_for_the_next_is_of_the_next() -> None:
    stuck = strike("sensor-stuck", "lower", 100, 200, joint="elbow", count=90)
    noise = strike("sensor-noise", "lower", 300, 350, place=1, joint="elbow", size=1.0)
    first, second = verdict([stuck, noise], found(300, "sensor_model", "lower", "elbow")).faults
    assert (first.seen, second.seen, second.delay) == ("missed", "detected", 0)


@pytest.mark.parametrize(("count", "seen"), [(4, "not struck"), (5, "missed")])
def test_a_fault_of_the_arm_that_is_over_before_it_must_be_found_has_not_struck(
    count: int, seen: str
) -> None:
    off = strike("actuator-off", "lower", 100, 150, joint="elbow", count=count)
    assert judged(off).seen == seen
    late = replace(off, count=4)
    assert judged(late, found(103, "actuator", "lower", "elbow")).seen == "detected"


def test_no_motor_at_fault_explains_an_alarm_about_another() -> None:
    wrist = found(104, "actuator", "lower", "wrist")
    off = strike("actuator-off", "lower", 100, 150, joint="elbow")
    assert verdict([off], wrist).unexplained == (wrist,)
    assert verdict([replace(off, joint="")], wrist).unexplained == ()


def test_a_fault_of_the_arm_that_is_found_has_struck_however_slight_it_was() -> None:
    slight = replace(strike("actuator-off", "lower", 100, 150), count=0)
    own, other = (
        found(104, "actuator", "lower", "elbow"),
        found(104, "sensor_range", "lower", "elbow"),
    )
    found_out = verdict([slight], own, other)
    fault = found_out.faults[0]
    assert (fault.seen, fault.struck, fault.delay, fault.bound) == ("detected", 100, 4, None)
    assert found_out.unexplained == (other,)
    # What is found after its end is of the next one.
    after = strike("actuator-off", "lower", 156, 170, place=1, joint="elbow")
    first, second = verdict([slight, after], found(160, "actuator", "lower", "elbow")).faults
    assert (first.seen, second.seen, second.delay) == ("not struck", "detected", 4)
    assert first.struck == -1


def test_faults_are_listed_as_they_struck_and_those_that_never_did_last() -> None:
    late, never, first = (
        strike("hang", "upper", 100, 200),
        strike("mute", "lower", NEVER, NEVER),
        strike("hang", "lower", 0, 50),
    )
    outcome = {
        "kind": "outcome",
        "outcome": {},
        "faults": [asdict(one) for one in (late, never, first)],
    }
    found = faults([outcome], LAYOUT)["faults"]
    assert [(one["kind"], one["board"], one["struck"]) for one in found] == [
        ("hang", "lower", 0),
        ("hang", "upper", 100),
        ("mute", "lower", never.tick),
    ]
