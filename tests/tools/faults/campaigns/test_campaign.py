"""The course of a campaign, without its trials: which are made, kept, and drawn again."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Self
from unittest.mock import Mock

import pytest

from rack.boards.config import RackConfig
from rack.tools.console.answer import Failure
from rack.tools.faults.campaigns import campaign as module
from rack.tools.faults.campaigns.campaign import Campaign, Order
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.results import TrialResult
from rack.tools.faults.campaigns.workers import TrialJob
from tests.tools.faults.campaigns.test_report import RUN
from tests.tools.faults.campaigns.test_statistics import judgement


def struck(plan: Plan) -> TrialResult:
    """Return a trial in which every fault of its plan has struck and was found."""
    faults = tuple(judgement(table["kind"]) for table in plan.faults)
    return replace(RUN, plan=plan, ticks=4000, faults=faults)


class Trials:
    """Stands for the workers: each trial ends as `ends` says; `made` are their plans."""

    def __init__(self, ends: Callable[[Plan], TrialResult]) -> None:
        self.ends = ends
        self.made: list[Plan] = []
        self.whole = False

    def __call__(self, config: object, whole: bool) -> Self:
        self.whole = whole
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        return

    def run(self, jobs: Sequence[TrialJob], alone: bool) -> Iterator[TrialJob]:
        """Keep the result of each."""
        for job in jobs:
            assert alone is not job.plan.lockstep
            self.made.append(job.plan)
            job.path.parent.mkdir(parents=True, exist_ok=True)
            job.path.write_text(json.dumps({"finding": asdict(self.ends(job.plan))}))
            yield job


MakeCampaign = Callable[..., tuple[Campaign, Trials]]


@pytest.fixture
def make(config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> MakeCampaign:
    """Make a campaign in a folder of the test, whose trials all go well unless it says
    otherwise."""

    def make_one(
        ends: Callable[[Plan], TrialResult] = struck, whole: bool = False, **given: Any
    ) -> tuple[Campaign, Trials]:
        trials = Trials(ends)
        monkeypatch.setattr(module, "Workers", trials)
        order = Order(**{"config": config, "name": "small", **ORDER, **given})
        campaign = Campaign(order, tmp_path / "out", Mock(), whole)
        return campaign, trials

    return make_one


ORDER: dict[str, Any] = {
    "kinds": "mute,drop",
    "injections": 3,
    "kills": 0,
    "sizes": 0,
    "seed": 5,
    "modes": (True,),
    "seconds": None,
}


def test_each_kind_strikes_as_often_as_ordered(make: MakeCampaign) -> None:
    campaign, trials = make()
    results = campaign.run()
    kinds = [table["kind"] for plan in trials.made for table in plan.faults]
    assert (kinds.count("mute"), kinds.count("drop"), len(kinds)) == (3, 3, 6)
    assert [plan.number for plan in trials.made] == list(range(len(trials.made)))
    assert trials.made[0].purpose == "nominal"
    assert (results.lacking, results.is_interrupted) == ([], False)
    assert [run.plan for run in results.trials] == trials.made[1:]


def test_faults_that_did_not_act_are_drawn_again_and_finally_reported(make: MakeCampaign) -> None:
    def never_mute(plan: Plan) -> TrialResult:
        found = struck(plan)
        faults = [
            replace(one, seen="not struck") if one.kind == "mute" else one for one in found.faults
        ]
        return replace(found, faults=tuple(faults))

    campaign, trials = make(never_mute)
    results = campaign.run()
    kinds = [table["kind"] for plan in trials.made for table in plan.faults]
    # Each round more of them, up to four of each that is missing.
    again = sum(min(turn + 1, module.MAX_DRAWS) for turn in range(1, module.ROUNDS))
    assert (kinds.count("mute"), kinds.count("drop")) == (3 + 3 * again, 3)
    assert results.lacking == [f"mute acted only 0 of 3 times in {module.ROUNDS} rounds"]


def test_saved_trials_are_not_repeated(make: MakeCampaign) -> None:
    first, trials = make()
    before = first.run()
    second, again = make()
    assert second.run().trials == before.trials
    assert again.made == []
    # A file of another plan, drawn by another version, is none.
    path = first.folder / "trials" / "0001.json"
    found = json.loads(path.read_text())
    found["finding"]["plan"]["number"] = 99
    path.write_text(json.dumps(found))
    third, once_more = make()
    third.run()
    assert once_more.made == [trials.made[1]]


def test_a_campaign_continued_with_whole_trials_keeps_saved_ones(make: MakeCampaign) -> None:
    campaign, trials = make()
    campaign.run()
    assert not trials.whole
    whole, others = make(whole=True)
    (whole.folder / "trials" / "0001.json").unlink()
    whole.run()
    assert others.whole
    assert others.made == [trials.made[1]]


def test_a_folder_of_another_campaign_is_refused(make: MakeCampaign) -> None:
    make()[0].run()
    with pytest.raises(Failure, match="belongs to a campaign that differs in seed") as caught:
        make(seed=6)[0].run()
    assert caught.value.status == 2


@pytest.mark.parametrize(
    ("end", "why"),
    [
        ({"ended": "neither"}, "the task is not done even without faults: "),
        ({"shortfalls": ("left behind: x",)}, "without faults: left behind: x"),
    ],
)
def test_a_rack_whose_task_fails_without_faults_has_no_campaign(
    make: MakeCampaign, end: dict[str, Any], why: str
) -> None:
    campaign, trials = make(lambda plan: replace(struck(plan), **end))
    with pytest.raises(Failure, match=why):
        campaign.run()
    assert len(trials.made) == 1


def test_a_trial_with_shortfalls_leaves_a_plan_that_repeats_it(make: MakeCampaign) -> None:
    def late(plan: Plan) -> TrialResult:
        return replace(struck(plan), shortfalls=("late",) if plan.number == 1 else ())

    campaign, trials = make(late)
    campaign.run()
    (path,) = campaign.folder.glob("trial-*.toml")
    assert path.name == "trial-0001.toml"
    assert path.read_text() == trials.made[1].format_faults("small")


def test_short_runs_are_repeated_to_fill_the_faultless_time(make: MakeCampaign) -> None:
    campaign, trials = make(faultless_s=25.0, modes=(False,), kinds="mute", loads=(False,))
    results = campaign.run()
    faultless = [plan for plan in trials.made if plan.purpose == "faultless"]
    # Each is done after 10 s.
    (stretch,) = results.faultless
    assert len(faultless) == len(stretch.runs) == 3
    assert (stretch.load, stretch.seconds) == ("", 30.0)
    assert not any(plan.lockstep for plan in faultless)
