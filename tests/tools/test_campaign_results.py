"""When a trial falls short, and how its task ended: from hand-made trials."""

from __future__ import annotations

from dataclasses import replace

import pytest

from boards.events import Event
from boards.outcome import Cause, Outcome
from tests.tools.campaign_events import LAYOUT, event, found, strike
from tools.campaign.ending import Arm, Strike
from tools.campaign.plan import Plan
from tools.campaign.results import Faultless, Judged, Results, misses_of
from tools.campaign.trial import Trial

FAULT = strike("mute", "lower", 100, 150)
SEEN = found(105, "mute", "upper", "lower.status")


def outcome(cause: Cause = "task done", *faults: str) -> Outcome:
    return Outcome(cause, 10_000, "done", "", "digest", faults)


def trial(*events: Event, strikes: tuple[Strike, ...] = (FAULT,)) -> Trial:
    return Trial(
        plan=Plan(1, "faults", lockstep=False),
        layout=LAYOUT,
        outcome=outcome(),
        refused="",
        events=(*events, event(9999, "end", "")),
        strikes=strikes,
        arm=Arm(),
        left=(),
        wall_s=1.0,
        offset_ns=0,
    )


def refused(kind: str, why: str) -> Judged:
    plan = Plan(1, "faults", True, ({"kind": kind, "board": "lower"},))
    return Judged.of(replace(trial(strikes=()), plan=plan, outcome=None, refused=why))


def test_a_trial_whose_fault_is_found_and_whose_task_is_done_falls_short_in_nothing() -> None:
    good = Judged.of(trial(SEEN))
    assert (good.ended, good.shortfalls) == ("task done", [])


@pytest.mark.parametrize(
    ("bad", "line"),
    [
        (trial(), "mute of lower.status, struck at tick 100: not detected"),
        (
            trial(found(140, "mute", "upper", "lower.status")),
            "mute of lower.status, struck at tick 100: mute by upper after 40 ticks; bound 10",
        ),
        (replace(trial(SEEN), arm=Arm(violations=3)), "limits violated at 3 substeps"),
        (replace(trial(SEEN), left=("process 7 (x:servo)",)), "left behind: process 7 (x:servo)"),
        (trial(SEEN, found(9000, "gap", "upper", "lower.status")), "upper: gap: no fault explains it (tick 9000)"),
        (
            replace(trial(SEEN), outcome=outcome("stopped"), levels="lower executing"),
            "the task is neither done nor safely stopped: stopped; lower executing",
        ),
    ],
)
def test_each_shortfall_is_a_line(bad: Trial, line: str) -> None:
    assert Judged.of(bad).shortfalls == [line]


def test_a_task_is_safely_stopped_when_the_arm_stands_and_no_limit_was_violated() -> None:
    lost = replace(trial(SEEN), outcome=outcome("board lost", "board 'lower' ended"))
    assert Judged.of(lost).ended == "safely stopped"
    assert Judged.of(replace(lost, arm=Arm(is_at_rest=False))).ended == "neither"
    assert Judged.of(replace(lost, arm=Arm(violations=1))).ended == "neither"


def test_a_self_test_that_fails_is_found_when_the_rack_does_not_arm_because_of_it() -> None:
    good = refused("self-test", "board 'lower': the self-test fails")
    assert (good.ended, good.shortfalls) == ("not armed", [])
    assert good.verdict.faults[0].seen == "detected"
    assert refused("self-test", "board 'upper': the self-test fails").verdict.faults[0].seen == "missed"


def test_a_self_test_that_fails_and_lets_the_rack_arm_is_missed() -> None:
    launched = Judged.of(trial(strikes=(strike("self-test", "lower", 0),)))
    assert launched.verdict.faults[0].seen == "missed"


def test_a_rack_that_does_not_launch_without_a_reason_falls_short() -> None:
    judged = refused("kill", "boards lower: not ready within 60 s")
    assert judged.ended == "neither"
    assert judged.verdict.faults[0].seen == "not struck"


def test_trips_are_counted_by_the_hour_and_misses_beside_them() -> None:
    calm = [
        Judged.of(trial(event(50, "miss", "late"), event(60, "miss", "late"), strikes=())),
        Judged.of(trial(found(70, "stale", "upper", "lower.status"), strikes=())),
    ]
    document = Faultless(2, 1800.0, tuple(calm)).document()
    assert (document["trips"], document["trips_per_hour"]) == (1, 2.0)
    assert document["misses"] == misses_of([judged.trial for judged in calm]) == {"late": 2}
    assert [event["code"] for event in document["tripped"]] == ["stale"]


def test_what_any_run_breaks_counts_whatever_the_run_is_for() -> None:
    nominal = Judged.of(trial(strikes=()))
    swept = Judged.of(replace(trial(SEEN), arm=Arm(violations=2)))
    results = Results(nominal, trials=[Judged.of(trial(SEEN))], sizes=[swept])
    assert sum(judged.trial.arm.violations for judged in results.runs) == 2
    assert len(results.faults) == 1
