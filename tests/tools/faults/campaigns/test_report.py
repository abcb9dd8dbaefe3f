"""The report of a campaign, from hand-made results: what counts where, and how it reads."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rack.tools.faults.campaigns.campaign import Campaign
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.report import MAX_SHOWN, CampaignReport
from rack.tools.faults.campaigns.results import FaultlessTime, Results, TrialResult
from tests.tools.fault_events import LAYOUT, TICK_NS, found
from tests.tools.faults.campaigns.test_statistics import judgement

SECOND = 1_000_000_000 // TICK_NS
RUN = TrialResult(
    plan=Plan(0, "nominal", lockstep=True),
    ended="task done",
    ticks=10 * SECOND,
    digest="abcd",
    violations=0,
    touches=0,
    left=(),
    wall_s=1.24,
    notes=("a note of lockstep",),
    misses={},
    stray_misses=0,
    faults=(),
    unexplained=(),
    shortfalls=(),
)


def run(number: int, *, lockstep: bool = False, **more: Any) -> TrialResult:
    """Return a trial without faults that has gone well."""
    plan = Plan(number, "faults", lockstep=lockstep)
    return replace(RUN, plan=plan, notes=("no real time",), **more)


TRIALS = [
    run(1, faults=(judgement(), judgement(struck=-1, seen="not struck")), stray_misses=2),
    run(
        2,
        lockstep=True,
        ended="safely stopped",
        stray_misses=5,
        faults=(judgement(delay=None, struck=0), judgement("sensor-bias", size=0.02, joint="j1")),
        shortfalls=("late",),
    ),
    run(3, ended="neither", violations=3, touches=1, left=("process 7",)),
]


def report_of(results: Results) -> CampaignReport:
    order = SimpleNamespace(name="small", seed=9, modes=(True, False))
    campaign = SimpleNamespace(layout=LAYOUT, kinds=("mute", "sensor-bias"), order=order)
    return CampaignReport(cast(Campaign, campaign), results, 61.26)


@pytest.fixture
def made() -> CampaignReport:
    """Return the report of three trials, one run with a known size, and one without faults."""
    trip = found(7, "gap", "upper", "lower.status")
    calm = run(0, ticks=20 * SECOND, unexplained=(trip,), misses={"plan_late": 2}, stray_misses=9)
    swept = run(4, faults=(judgement("sensor-bias", delay=None, size=0.01, struck=40),))
    faultless = FaultlessTime("a load", 20.0, (calm,))
    results = Results(RUN, list(TRIALS), [swept], [faultless], ["overrun: did not strike"])
    return report_of(results)


def test_the_figures_summarise_the_right_runs(made: CampaignReport) -> None:
    report = made.to_document()
    summary = report["summary"]
    ends = ("trials", "tasks_done", "safely_stopped", "neither")
    assert [summary[key] for key in ends] == [3, 1, 1, 1]
    assert (summary["injected"], summary["detected"], summary["not_struck"]) == (3, 2, 1)
    assert (summary["limits_violated"], summary["touches"], summary["left_behind"]) == (3, 1, 1)
    # The nominal run, three trials, one of the sweep, and 20 s without faults.
    assert summary["simulated_s"] == 70.0
    assert summary["unexplained"] == 1
    assert summary["unexplained_per_hour"]["an_hour"] == pytest.approx(3600 / 70, abs=1e-3)
    # In lockstep no miss is stray, and those without faults are counted apart.
    assert summary["stray_misses"] == 2
    assert (summary["false_trips"], summary["faultless_s"]) == (1, 20.0)
    assert summary["false_trips_per_hour"]["an_hour"] == 180.0
    assert (report["wall_s"], report["clock_ms"]) == (61.3, 2.5)
    assert report["modes"] == ["lockstep", "realtime"]
    assert report["nominal"] == {"ticks": 4000, "seconds": 10.0, "digest": "abcd"}
    assert report["machine"]["notes"] == ["no real time"]
    assert report["shortfalls"] == ["trial 2: late", "overrun: did not strike"]


def test_the_text_agrees_with_the_document(made: CampaignReport) -> None:
    lines = made.to_markdown().splitlines()
    assert lines[0] == "# Campaign on small, seed 9: fell short"
    assert lines[2].startswith("3 trials, lockstep and realtime, in 61 s on ")
    assert lines[3] == "- no real time"
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line]
    cells = {row[0]: row[1:] for row in rows}
    assert cells["injected"] == ["3; 1 more did not strike and were drawn again"]
    assert cells["trials ended"] == ["1 task done, 1 safely stopped, 1 neither"]
    assert cells["recovered from"] == ["3"]
    assert cells["false detections"][0].startswith("1 in 0.02 simulated hours: 51.4 an hour, below")
    assert cells["of these without faults, in real time"][0].startswith("1 in 20 s: 180 an hour")
    # Injected, detected, in bound, recovered, at least; ticks; bound; ms; recovery; reactions.
    mute = cells["mute"]
    assert mute[:4] == ["2", "1", "1", "2"]
    assert mute[4].endswith("%")
    assert mute[5:8] == ["5", "5", "10"]
    assert mute[-3:] == ["-", "-", "-"]
    assert cells["under a load"] == [*("20", "1"), cells["under a load"][2], "2 plan late"]
    assert "## sensor-bias: size against delay" in lines
    assert cells["0.01"] == ["all", "-"]
    assert cells["0.02"] == ["j1", "12.5"]
    assert lines[-3:] == ["", "- trial 2: late", "- overrun: did not strike"]


def test_a_campaign_without_shortfalls_has_passed() -> None:
    text = report_of(Results(RUN, is_interrupted=True)).to_markdown()
    assert text.startswith("# Campaign on small, seed 9: passed\n")
    assert "The campaign was interrupted." in text
    assert not any(
        word in text for word in ("Shortfalls", "Faults by kind", "Faultless", "of these without")
    )


def test_the_text_shows_the_first_of_many_shortfalls() -> None:
    many = report_of(Results(RUN, lacking=[f"line {k}" for k in range(MAX_SHOWN + 1)]))
    assert f"## Shortfalls: {MAX_SHOWN + 1}" in many.to_markdown()
    assert many.to_markdown().endswith(f"- line {MAX_SHOWN - 1}\n")
    assert len(many.to_document()["shortfalls"]) == MAX_SHOWN + 1
