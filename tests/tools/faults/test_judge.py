"""The judge of faults, on hand-made faults and events."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import pytest

from rack.backplane.fault_table import NEVER
from rack.boards.events import Event
from rack.tools.faults import judge
from rack.tools.faults.ending import EXTERNAL, Strike
from rack.tools.faults.judge import Circumstances, FaultVerdict, Judge, Judgement
from tests.tools.fault_events import LAYOUT, TICK_NS, box, event, flows, found, strike

END = event(10_000, "end", "")
REAL_TIME = Circumstances(LAYOUT, offset_ns=0)
LOCKSTEP = replace(REAL_TIME, is_lockstep=True)
FAILED = replace(REAL_TIME, has_failed=True)

MUTE, KILL = strike("mute", "lower", 100, 150), strike("kill", "lower", 100)
OVERRUN = strike("overrun", "lower", 100, 150)
NAN = strike("command-nan", "lower", 100, 110)
OFF = strike("actuator-off", "lower", 100, 150, joint="elbow")
STUCK = strike("sensor-stuck", "lower", 100, 2000, count=1900)
MUTED = "lower.status"
SEEN = found(107, "mute", "upper", MUTED)
DIED = Event(100 * TICK_NS + 49_900_000, 101, "died", "lower", "died", "died")
CLOSED = event(100, "reaction", "brakes_closed", "lower")
LATCHED = event(900, "reaction", "latched", "lower")
RESTART = event(100, "reaction", "restart", "lower")
REJOINED = event(300, "recovery", "rejoined", "lower")
SKIPS = [event(106, "miss", "clock_skipped", board, value=5.0) for board in ("upper", "lower")]
ELBOW = found(103, "actuator", "lower", "elbow")
OPENED = event(110, "recovery", "brakes_opened", "lower")
INVALID, LIMIT = (
    found(100, code, "lower", "elbow") for code in ("command_invalid", "command_limit")
)


def verdict(strikes: list[Strike], *events: Event, run: Circumstances = REAL_TIME) -> FaultVerdict:
    return Judge(strikes, [*events, END], run).judge_all()


def judged(one: Strike, *events: Event, run: Circumstances = REAL_TIME) -> Judgement:
    return verdict([one], *events, run=run).faults[0]


MISSED = {"seen": "missed", "delay": None, "is_within": False}
FOUND: dict[str, tuple[Strike, list[Event], dict[str, Any]]] = {
    # 2 cycles of the writer and one of the reader.
    "by an alarm of its kind about its mailbox": (
        MUTE,
        [SEEN],
        {"seen": "detected", "found_by": "upper", "found_as": "mute", "delay": 7, "bound": 2 + 8}
        | {"is_within": True, "delay_ms": 7.5 * 2.5},
    ),
    "late": (MUTE, [replace(SEEN, tick=111)], {"seen": "detected", "is_within": False}),
    "by nobody": (strike("hang", "upper", 100, 200), [], MISSED),
    "not by another alarm": (MUTE, [replace(SEEN, code="stale")], MISSED),
    "not about another mailbox": (MUTE, [found(104, "mute", "lower", "upper.command")], MISSED),
    "not before it struck": (MUTE, [replace(SEEN, tick=99)], MISSED),
    "not by its own begin": (MUTE, [event(104, "fault", "begins", "lower", MUTED)], MISSED),
    "not if it never acted": (
        replace(strike("drop", "lower", 100, 150), tick=-1, count=0),
        [found(110, "gap", "upper", MUTED)],
        {"seen": "not struck", "is_within": False},
    ),
    # The two tasks tell of the same five ticks.
    "without the ticks that the clock left out": (
        MUTE,
        [*SKIPS, replace(SEEN, tick=115)],
        {"delay": 10, "is_within": True},
    ),
    "a skip of the clock, by the ticks that it leaves out": (
        strike("clock-skip", "clock", 100),
        [event(101, "miss", "clock_skipped", "lower", value=1.0)],
        {"seen": "detected", "delay": 1, "bound": 1, "is_within": True},
    ),
    "at its joint": (replace(NAN, joint="elbow"), [INVALID], {"seen": "detected"}),
    "not at another joint": (replace(NAN, joint="wrist"), [INVALID], {"seen": "missed"}),
    "at no joint": (replace(NAN, joint="elbow"), [replace(INVALID, subject="")], {"delay": 0}),
    "in its own cycle, not later": (NAN, [replace(INVALID, tick=101)], {"is_within": False}),
    # A small error of a sensor need not be found.
    "small": (strike("sensor-bias", "lower", 100, 110, size=1e-4), [], {"is_judged": False}),
    "great": (strike("sensor-bias", "lower", 100, 110, size=1.0), [], {"is_judged": True}),
    "no sooner than it shows": (
        replace(strike("actuator-saturated", "lower", 100, 150), hidden=15, count=30),
        [replace(ELBOW, tick=127)],
        {"struck": 100, "delay": 27, "bound": 15 + 12, "is_within": True},
    ),
    "over before it must be found": (replace(OFF, count=4), [], {"seen": "not struck"}),
    "not over before it must be found": (replace(OFF, count=5), [], {"seen": "missed"}),
    "over, and found": (replace(OFF, count=4), [ELBOW], {"seen": "detected"}),
}


BRAKED = event(104, "reaction", "brakes_closed", "lower", value=3.0)
UNDONE = {"is_recovered": False, "recovery": None}
FLOWING = 50 + 1 + 1 + 100
"""A message is due a tick after the end, and read a tick later; then a quarter of a second."""
RECOVERED: dict[str, tuple[Strike, list[Event], dict[str, Any]]] = {
    "when the last reaction is undone": (
        KILL,
        [RESTART, replace(CLOSED, tick=103), REJOINED, replace(OPENED, tick=340)],
        {"reactions": ("restart", "brakes_closed"), "is_recovered": True, "recovery": 240},
    ),
    "not when another board rejoins": (KILL, [RESTART, replace(REJOINED, board="upper")], UNDONE),
    "when brakes that closed for missed cycles open": (
        OVERRUN,
        [BRAKED, replace(OPENED, tick=107)],
        {"reactions": ("brakes_closed",), "is_recovered": True, "recovery": 7},
    ),
    "not while the brakes are closed": (strike("sensor-nan", "lower", 100), [CLOSED], UNDONE),
    "whatever is latched that it cannot latch": (
        MUTE,
        [replace(LATCHED, tick=110), flows(152)],
        {"reactions": (), "is_recovered": True},
    ),
    # They are for the missed cycles of another.
    "not with those brakes": (strike("drop", "upper", 100, 110), [BRAKED], {"reactions": ()}),
    "whatever comes long after it": (NAN, [replace(CLOSED, tick=5000)], {"reactions": ()}),
    # A quarter of a second after the end of the fault.
    "within its bound": (
        NAN,
        [INVALID, CLOSED, replace(OPENED, tick=110 + 100)],
        {"is_recovered": True, "recovery_bound": 110},
    ),
    "not beyond its bound": (
        NAN,
        [INVALID, CLOSED, replace(OPENED, tick=110 + 101)],
        {"is_recovered": False, "recovery_bound": 110},
    ),
    "not while messages do not flow": (MUTE, [SEEN], UNDONE | {"recovery_bound": FLOWING}),
    "not by messages before its end": (MUTE, [SEEN, flows(149)], UNDONE),
    "not by those of another mailbox": (MUTE, [SEEN, flows(152, "upper.command")], UNDONE),
    "when messages flow": (MUTE, [SEEN, flows(152)], {"is_recovered": True, "recovery": 52}),
    "when they flow again in time": (
        MUTE,
        [SEEN, flows(149), flows(252)],
        {"is_recovered": True, "recovery": FLOWING},
    ),
    "not when they flow again too late": (
        MUTE,
        [SEEN, flows(253)],
        {"is_recovered": False, "recovery": 153},
    ),
}


CASES = {f"found {when}": case for when, case in FOUND.items()}
CASES |= {f"recovered from {when}": case for when, case in RECOVERED.items()}


@pytest.mark.parametrize(("struck", "events", "expected"), CASES.values(), ids=CASES)
def test_a_fault_is_judged(struck: Strike, events: list[Event], expected: dict[str, Any]) -> None:
    fault = asdict(judged(struck, *events))
    assert {name: fault[name] for name in expected} == expected


HIT = replace(
    found(300, "collision", "lower", "arm"), text="unintended contact: 'arm' touches 'post'"
)
HELD_UP = [CLOSED, OPENED, HIT, replace(CLOSED, tick=300)]
LATE = event(105, "miss", "late", "clock", "lower")
STALE = found(110, "stale", "upper", MUTED)
# Its bound, a cycle and two seconds and a quarter for a restart, the last message's way, a quarter
# of a second.
LAST = 100 + 2 + 1 + 900 + (1 + 8) + 100
FORGED = strike("masquerade", "lower", 100)
IN_WAY, DOOR = (replace(REAL_TIME, moving=(name,)) for name in ("post", "door"))
EXPLAINED = [
    (KILL, [STALE], REAL_TIME, []),
    (KILL, [replace(STALE, tick=LAST)], REAL_TIME, []),
    (KILL, [replace(STALE, tick=LAST + 1)], REAL_TIME, [0]),
    (KILL, [found(110, "stale", "lower", "upper.command")], REAL_TIME, [0]),
    (KILL, [found(110, "damaged", "upper", MUTED)], REAL_TIME, [0]),
    (KILL, [found(110, "sensor_nan", "lower", "elbow")], REAL_TIME, [0]),
    (KILL, [found(110, "hang", "clock", "upper")], REAL_TIME, [0]),
    (KILL, [event(110, "died", "died", "upper")], REAL_TIME, [0]),
    (MUTE, [replace(SEEN, tick=5000), replace(LATE, tick=4000)], REAL_TIME, [0]),
    # What a task finds has the tick of its release, which may be before the fault.
    (FORGED, [found(97, "masquerade", "lower.planner", MUTED)], REAL_TIME, []),
    (FORGED, [found(94, "masquerade", "lower.planner", MUTED)], REAL_TIME, [0]),
    # A sensor at fault may show at any joint, a motor at its own.
    (
        strike("sensor-bias", "lower", 100, 110, joint="elbow", size=1.0),
        [found(101, "sensor_model", "lower", "wrist")],
        REAL_TIME,
        [],
    ),
    (OFF, [found(104, "actuator", "lower", "wrist")], REAL_TIME, [0]),
    (replace(OFF, joint=""), [found(104, "actuator", "lower", "wrist")], REAL_TIME, []),
    # An obstacle that moves may meet an arm that a fault has kept, and nothing else may.
    (replace(OFF, ends=110, count=9), HELD_UP, IN_WAY, []),
    (replace(OFF, ends=110, count=9), HELD_UP, DOOR, [2]),
    (replace(OFF, tick=301, began=301, ends=310, count=9), HELD_UP, IN_WAY, [2]),
]


@pytest.mark.parametrize(("struck", "events", "run", "unexplained"), EXPLAINED)
def test_a_fault_explains_only_consequences_of_its_kind_in_its_window(
    struck: Strike, events: list[Event], run: Circumstances, unexplained: list[int]
) -> None:
    found_out = verdict([struck], *events, run=run)
    assert found_out.unexplained == tuple(events[place] for place in unexplained)


@pytest.mark.parametrize(
    ("struck", "events", "lacking"),
    [
        (KILL, [event(101, "died", "died", "lower")], ("restart",)),
        (NAN, [], ("brakes_closed",)),
        (MUTE, [], ()),
        # Brakes that are engaged when it strikes need not be engaged for it.
        (NAN, [LIMIT, replace(CLOSED, tick=60)], ()),
        (NAN, [replace(CLOSED, tick=60), replace(OPENED, tick=99)], ("brakes_closed",)),
        (NAN, [replace(CLOSED, tick=60), replace(OPENED, tick=101)], ()),
    ],
)
def test_a_required_reaction_that_does_not_follow_is_lacking(
    struck: Strike, events: list[Event], lacking: tuple[str, ...]
) -> None:
    assert judged(struck, *events).lacking == lacking


@pytest.mark.parametrize(
    ("struck", "events", "run", "recovered"),
    [
        (STUCK, [CLOSED, LATCHED], FAILED, True),
        (STUCK, [CLOSED, LATCHED], REAL_TIME, False),
        # A rack that just waits has not latched anything.
        (STUCK, [CLOSED], FAILED, False),
        (replace(NAN, ends=2000), [CLOSED, LATCHED], REAL_TIME, False),
    ],
)
def test_a_fault_that_may_be_latched_is_recovered_from_when_it_is_and_the_task_ends_with_it(
    struck: Strike, events: list[Event], run: Circumstances, recovered: bool
) -> None:
    assert judged(struck, *events, run=run).is_recovered is recovered


def test_the_brakes_for_an_obstacle_in_the_way_are_no_reaction_to_a_motor() -> None:
    fault = judged(replace(OFF, ends=110, count=9), *HELD_UP, run=IN_WAY)
    assert fault.recovery == 10


def test_one_alarm_is_the_detection_of_one_of_two_equal_faults() -> None:
    both = [strike("corrupt", "lower", 100, 200), strike("corrupt", "lower", 101, 200, place=1)]
    alarms = [found(tick, "damaged", "upper", MUTED) for tick in (103, 111)]
    assert [fault.seen for fault in verdict(both, alarms[0]).faults] == ["detected", "missed"]
    assert [fault.seen for fault in verdict(both, *alarms).faults] == ["detected", "detected"]


@pytest.mark.parametrize("kind", ["kill", EXTERNAL])
def test_a_death_that_the_rack_finds_late_is_late_whatever_its_neighbours_find(kind: str) -> None:
    killed, stale = strike(kind, "lower", 100), found(104, "stale", "upper", MUTED)
    fault = judged(killed, stale, DIED)
    assert (fault.found_by, fault.delay_ms, fault.bound_ms) == ("the Rack", 49.9, 50.0)
    assert fault.is_within
    late = replace(DIED, time_ns=100 * TICK_NS + 50_100_000)
    assert not judged(killed, stale, late).is_within
    # Nobody but the Rack has noticed: that is no detection of a death.
    assert judged(killed, stale).seen == "missed"


def test_in_lockstep_a_death_is_bounded_in_ticks() -> None:
    died = Event(900 * TICK_NS, 99, "died", "lower", "died", "died")
    fault = judged(KILL, died, run=LOCKSTEP)
    # It strikes before its tick is given out: the Rack may see the tick before.
    assert (fault.seen, fault.delay, fault.bound) == ("detected", 0, 2)
    assert (fault.delay_ms, fault.is_within) == (None, True)
    # One that the clock knows nothing of has neighbours for its bound.
    fault = judged(strike(EXTERNAL, "lower", 100), replace(died, tick=190), run=LOCKSTEP)
    assert (fault.delay, fault.bound, fault.is_within) == (90, None, True)


def test_reactions_after_the_next_fault_belong_to_that_fault() -> None:
    both = [NAN, strike("kill", "lower", 500, place=1)]
    events = replace(RESTART, tick=500), replace(REJOINED, tick=700)
    first, second = verdict(both, *events).faults
    assert (first.reactions, first.recovery) == ((), None)
    assert (second.reactions, second.recovery) == (("restart",), 200)


def test_a_run_that_ends_before_the_bound_of_a_recovery_says_nothing_about_it() -> None:
    ends = [[INVALID, CLOSED, replace(END, tick=end)] for end in (209, 210)]
    faults = [Judge([NAN], events, REAL_TIME).judge_all().faults[0] for events in ends]
    assert [fault.is_recovered for fault in faults] == [True, False]


def test_nothing_recovers_from_a_fault_of_messages_without_an_end() -> None:
    end, silent = replace(END, tick=200), replace(MUTE, ends=NEVER)
    (fault,) = Judge([silent], [flows(99), SEEN, end], REAL_TIME).judge_all().faults
    assert (fault.seen, fault.struck, fault.is_recovered) == ("detected", 100, False)
    # One that was to end says nothing yet.
    (fault,) = Judge([replace(MUTE, ends=900)], [SEEN, end], REAL_TIME).judge_all().faults
    assert fault.seen == "not struck"


def test_a_plan_is_recovered_from_whenever_the_next_one_comes_and_undecided_without_one() -> None:
    boxes = (*LAYOUT.mailboxes, box("lower.plan", "lower.planner", "lower", 4))
    run = Circumstances(replace(LAYOUT, mailboxes=boxes), offset_ns=0)
    forged = replace(strike("masquerade", "lower.planner", 100), mailboxes=("lower.plan",))
    late = verdict([forged], flows(9000, "lower.plan"), run=run).faults[0]
    assert (late.is_recovered, late.recovery) == (True, 8900)
    assert verdict([forged], run=run).faults[0].seen == "not struck"


def test_misses_that_no_fault_explains_are_counted_apart_from_detections() -> None:
    miss = event(105, "miss", "late", "clock", "upper")
    assert verdict([MUTE], miss).misses == (miss,)
    assert verdict([OVERRUN], miss).misses == ()
    assert verdict([OVERRUN], replace(miss, tick=5000)).misses != ()


def test_a_detection_too_late_for_one_fault_counts_for_the_next() -> None:
    stuck = strike("sensor-stuck", "lower", 100, 200, joint="elbow", count=90)
    noise = strike("sensor-noise", "lower", 300, 350, place=1, joint="elbow", size=1.0)
    first, second = verdict([stuck, noise], found(300, "sensor_model", "lower", "elbow")).faults
    assert (first.seen, second.seen, second.delay) == ("missed", "detected", 0)


def test_a_fault_of_the_arm_that_is_found_has_struck_however_slight_it_was() -> None:
    slight = replace(strike("actuator-off", "lower", 100, 150), count=0)
    own, other = (found(104, code, "lower", "elbow") for code in ("actuator", "sensor_range"))
    found_out = verdict([slight], own, other)
    fault = found_out.faults[0]
    assert (fault.seen, fault.struck, fault.delay, fault.bound) == ("detected", 100, 4, None)
    assert found_out.unexplained == (other,)
    # What is found after its end is of the next one.
    after = strike("actuator-off", "lower", 156, 170, place=1, joint="elbow")
    first, second = verdict([slight, after], replace(own, tick=160)).faults
    assert (first.seen, second.seen, second.delay) == ("not struck", "detected", 4)
    assert first.struck == -1


def test_faults_are_listed_as_they_struck_and_those_that_never_did_last() -> None:
    late, first = strike("hang", "upper", 100, 200), strike("hang", "lower", 0, 50)
    never = strike("mute", "lower", NEVER, NEVER)
    struck = [asdict(one) for one in (late, never, first)]
    found = judge.report_faults([{"kind": "outcome", "outcome": {}, "faults": struck}], LAYOUT)[
        "faults"
    ]
    assert [(one["kind"], one["board"], one["struck"]) for one in found] == [
        ("hang", "lower", 0),
        ("hang", "upper", 100),
        ("mute", "lower", never.tick),
    ]
