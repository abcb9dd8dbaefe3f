"""When a trial falls short, and how its task ended: from hand-made trials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards.events import Cause, Event, Outcome
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.results import (
    FaultlessTime,
    TrialResult,
    judge_trial,
    load_result,
    save_result,
)
from rack.tools.faults.campaigns.trial import Trial
from rack.tools.faults.ending import ArmEnd, Strike
from rack.tools.faults.judge import Circumstances
from tests.tools.fault_events import LAYOUT, event, flows, found, strike

FAULT = strike("mute", "lower", 100, 150)
SEEN = found(105, "mute", "upper", "lower.status")
FLOWS = flows(152)


def outcome(cause: Cause = "task done", *faults: str) -> Outcome:
    return Outcome(cause, 10_000, "done", "", "digest", faults)


def trial(*events: Event, strikes: tuple[Strike, ...] = (FAULT,)) -> Trial:
    return Trial(
        plan=Plan(1, "faults", lockstep=False),
        run=Circumstances(LAYOUT, offset_ns=0),
        outcome=outcome(),
        refused="",
        events=(*events, event(9999, "end", "")),
        strikes=strikes,
        arm=ArmEnd(),
        left=(),
        wall_s=1.0,
    )


GOOD, NAN = trial(SEEN, FLOWS), strike("command-nan", "lower", 100, 110)


def refused(kind: str, why: str, again: Outcome | None = None) -> TrialResult:
    plan = Plan(1, "faults", True, ({"kind": kind, "board": "lower"},))
    made = replace(trial(strikes=()), plan=plan, run=None, outcome=None, refused=why, again=again)
    return judge_trial(made)


MUTED = "mute of lower.status at tick 100"
BAD = [
    (trial(FLOWS), f"{MUTED} was not detected"),
    (
        trial(found(140, "mute", "upper", "lower.status"), FLOWS),
        f"{MUTED} was reported as mute by upper after 40 ticks; its bound is 10",
    ),
    (
        trial(SEEN, FLOWS, event(110, "reaction", "restart", "lower")),
        f"{MUTED}: restart was never undone (bound in ticks: 152)",
    ),
    (trial(SEEN), f"{MUTED}: loss of messages was never undone (bound in ticks: 152)"),
    (
        trial(SEEN, flows(300)),
        f"{MUTED}: loss of messages was undone only after 200 ticks (bound in ticks: 152)",
    ),
    (
        trial(found(100, "command_invalid", "lower"), strikes=(NAN,)),
        "command-nan of lower at tick 100 was not followed by 'brakes closed'",
    ),
    (
        replace(GOOD, outcome=outcome("task failed", "level 'lower': blocked")),
        "the task is not done, and no fault had to end it: task failed; level 'lower': blocked",
    ),
    (replace(GOOD, arm=ArmEnd(violations=3)), "limits violated at 3 substeps"),
    (replace(GOOD, left=("process 7 (x:servo)",)), "left behind: process 7 (x:servo)"),
    (
        trial(SEEN, FLOWS, found(9000, "gap", "upper", "lower.status")),
        "no fault explains this event of upper at tick 9000: gap",
    ),
    (
        replace(GOOD, outcome=outcome("stopped"), levels="lower executing"),
        "the task is neither done nor safely stopped: stopped; lower executing",
    ),
]


@pytest.mark.parametrize(("bad", "line"), BAD)
def test_each_shortfall_is_one_line(bad: Trial, line: str) -> None:
    assert (judge_trial(GOOD).ended, judge_trial(GOOD).shortfalls) == ("task done", ())
    assert judge_trial(bad).shortfalls == (line,)


def test_a_task_is_safely_stopped_if_the_arm_is_at_rest_within_its_limits() -> None:
    lost = replace(GOOD, outcome=outcome("board lost", "board 'lower' ended"))
    assert judge_trial(lost).ended == "safely stopped"
    assert judge_trial(replace(lost, arm=ArmEnd(is_at_rest=False))).ended == "neither"
    assert judge_trial(replace(lost, arm=ArmEnd(violations=1))).ended == "neither"


def test_a_task_that_faults_have_made_late_may_give_up_and_any_other_may_not() -> None:
    events = (found(100, "command_invalid", "lower"), event(100, "reaction", "brakes_closed"))
    released = event(110, "recovery", "brakes_opened")
    braked = trial(*events, released, strikes=(NAN,))
    late = replace(braked, outcome=outcome("task refused"), is_late=True)
    assert judge_trial(late).shortfalls == ()
    assert judge_trial(replace(late, is_late=False)).shortfalls != ()
    assert judge_trial(replace(late, strikes=(FAULT,), events=(SEEN, FLOWS))).shortfalls != ()


def test_a_self_test_that_fails_is_found_when_the_rack_does_not_arm_because_of_it() -> None:
    why = "board 'lower': the self-test fails"
    good = refused("self-test", why, outcome("time over"))
    assert (good.ended, good.shortfalls) == ("not armed", ())
    assert (good.faults[0].seen, good.faults[0].is_recovered) == ("detected", True)
    # It is recovered from when the rack then runs without it.
    for again in (None, outcome("board lost", "board 'lower' ended")):
        assert refused("self-test", why, again).shortfalls == (
            "self-test of lower at tick 0: not armed was never undone",
        )
    assert refused("self-test", why.replace("lower", "upper")).faults[0].seen == "missed"
    launched = judge_trial(trial(strikes=(strike("self-test", "lower", 0),)))
    assert launched.faults[0].seen == "missed"


def test_a_rack_that_does_not_launch_without_a_reason_falls_short() -> None:
    judged = refused("kill", "boards lower: not ready within 60 s")
    assert judged.ended == "neither"
    assert judged.faults[0].seen == "not struck"


def test_trips_are_counted_by_the_hour_and_misses_beside_them() -> None:
    calm = [
        judge_trial(trial(event(50, "miss", "late"), event(60, "miss", "late"), strikes=())),
        judge_trial(trial(found(70, "stale", "upper", "lower.status"), strikes=())),
    ]
    stretch = FaultlessTime("stress-ng --cpu 2 --io 1", 1800.0, tuple(calm))
    document = stretch.to_document()
    # One in half an hour: below 4.74 in that time, with 95 %.
    assert (document["trips"], document["trips_per_hour"]) == (1, {"an_hour": 2.0, "below": 9.488})
    assert document["misses"] == stretch.misses == {"late": 2}
    assert [event["code"] for event in document["tripped"]] == ["stale"]
    assert [run.stray_misses for run in calm] == [2, 0]


def test_a_trial_is_saved_atomically(tmp_path: Path) -> None:
    made = trial(SEEN, FLOWS, found(9000, "gap", "upper", "lower.status"))
    path = tmp_path / "trials" / "1.json"
    assert load_result(path) is None
    save_result(made, path)
    assert load_result(path) == judge_trial(made)
    assert [file.name for file in path.parent.iterdir()] == ["1.json"]
