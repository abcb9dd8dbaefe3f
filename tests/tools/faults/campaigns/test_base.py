"""Trials that go on from the faultless run have the verdicts of whole ones, and say where they
begin."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from rack.boards.config import RackConfig, load, resolve_layout
from rack.boards.crate.line import WarmCrate
from rack.boards.faults.kind import KINDS
from rack.tools.faults.campaigns import base as base_rack
from rack.tools.faults.campaigns.base import BaseRack
from rack.tools.faults.campaigns.draw import RackUnderTest, fault_plans
from rack.tools.faults.campaigns.plan import NOMINAL, Kill, Plan, Targets, needs_real_time
from rack.tools.faults.campaigns.results import judge_trial
from rack.tools.faults.campaigns.trial import Start, Trial, run_trial
from tests.conftest import EXHAUSTIVE

pytestmark = pytest.mark.slow

SECONDS = 5.0
STRIKES = 330
MOVES = 1130
SAMPLE = 12
"""Kinds of faults that are tried, of about 40."""
MUTE = {"kind": "mute", "board": "lower", "tick": STRIKES, "for": "50ms"}
OF_ONE_RUN = ("wall_s", "notes", "start", "whole", "begins", "ended", "ticks", "digest", "touches")
"""Fields of a result that are not of the verdict, or of its end."""


@pytest.fixture
def crate() -> Iterator[WarmCrate]:
    with WarmCrate() as crate:
        yield crate


class Bench:
    """One rack's trials, whole or from its faultless run."""

    def __init__(self, config: RackConfig, name: str, crate: WarmCrate) -> None:
        self._config = config.model_copy(update={"fault": ()})
        self.base = BaseRack(self._config, name)
        self.crate = crate

    def run(self, plan: Plan, whole: bool = False) -> Trial:
        """Run a plan."""
        start = Start(whole="as asked") if whole else self.base.find_start(plan, self.crate)
        name = self.base.name
        return run_trial(self._config, plan, name, 0, SECONDS, start=start, crate=self.crate)


def verdict(trial: Trial) -> dict[str, Any]:
    """Return all that is judged of a trial, wherever it ends."""
    result = judge_trial(trial)
    found = {key: value for key, value in asdict(result).items() if key not in OF_ONE_RUN}
    return found | {"unexplained": [replace(event, time_ns=0) for event in result.unexplained]}


def one_of_each(config: RackConfig, kinds: Sequence[str]) -> list[Plan]:
    """Return a plan for each kind, with one fault at a place that a campaign draws, while the arm
    moves."""
    targets = Targets(config, resolve_layout(config))
    drawn = RackUnderTest(targets, round(SECONDS * 400), 400.0, 1.0)
    plans = []
    for number, kind in enumerate(kinds, 1):
        (plan,) = fault_plans(drawn, {kind: 1}, "5", True, number)
        (table,) = plan.faults
        at = {"tick": MOVES} if "tick" in table else {}
        plans.append(replace(plan, faults=({**table, **at},)))
    return plans


@pytest.mark.thorough
@pytest.mark.timeout(600)
def test_every_kind_of_fault_has_the_verdict_of_a_whole_trial(
    rack_name: str, crate: WarmCrate
) -> None:
    config = load("nasrem").model_copy(update={"fault": ()})
    targets = Targets(config, resolve_layout(config)).by_kind
    kinds = [kind for kind, at in targets.items() if at and not needs_real_time(kind)]
    # All that there are in lockstep; only a hand has tendons.
    others = {kind.name for kind in KINDS if not kind.realtime} - set(kinds)
    assert others == {"tendon-torn", "wrong-output"}
    if not EXHAUSTIVE:
        kinds = random.Random(43).sample(kinds, SAMPLE)
    bench = Bench(config, rack_name, crate)
    every = round(400 * base_rack.EVERY_S)
    idle = set[str]()
    cut = 0
    for plan in one_of_each(config, kinds):
        continued = bench.run(plan)
        whole = bench.run(plan, whole=True)
        assert verdict(continued) == verdict(whole), plan
        assert (whole.start.tick, whole.start.whole, whole.is_cut) == (0, "as asked", False)
        (fault,) = judge_trial(continued).faults
        if not plan.first_tick:
            assert (continued.start.tick, fault.found_as) == (0, "not armed")
            continue
        assert continued.start.tick == MOVES // every * every
        cut += continued.is_cut
        if fault.struck < plan.first_tick:
            idle.add(fault.kind)
    # The others have been something to judge, and many were certain before the end.
    assert len(idle) <= 3, idle
    assert cut >= len(kinds) // 3


@pytest.fixture
def bench(small: Path, rack_name: str, crate: WarmCrate, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setattr(base_rack, "EVERY_S", 0.25)
    return Bench(load(small), rack_name, crate)


def test_a_trial_continues_from_a_snapshot_and_ends_once_its_verdict_is_certain(
    bench: Bench,
) -> None:
    plan = Plan(1, "faults", True, (MUTE, {**MUTE, "tick": 520}))
    continued, whole = bench.run(plan), bench.run(plan, whole=True)
    assert verdict(continued) == verdict(whole)
    assert (continued.is_cut, whole.is_cut) == (True, False)
    assert continued.outcome is not None
    assert whole.outcome is not None
    # The second fault ends at tick 540 and is recovered from, so only late reports may follow:
    # after a reader's next cycle, and for 0.25 s.
    assert 540 + 100 < continued.outcome.ticks <= 540 + 100 + 10 < whole.outcome.ticks
    assert continued.start.tick == 300
    # With the events of the faultless rack until then.
    assert min(event.tick for event in continued.events) < 0
    # From the same snapshot, also after a whole trial.
    again = bench.run(plan)
    assert again.outcome is not None
    assert again.outcome.ticks == continued.outcome.ticks
    assert (verdict(again), again.start, again.is_cut) == (verdict(whole), continued.start, True)


@pytest.mark.thorough
def test_a_fault_begins_once_the_one_before_is_settled(bench: Bench) -> None:
    later = ((520, "upper.command"), (700, "lower.status"), (1000, "upper.command"))
    faults = tuple(
        {**MUTE, "board": box.partition(".")[0], "mailbox": box, "tick": tick}
        for tick, box in ((STRIKES, "lower.status"), *later)
    )
    plan = Plan(1, "faults", True, (*faults, {"kind": "kill", "board": "upper", "tick": 1200}))
    trial = bench.run(plan)
    begins = trial.begin_ticks
    assert trial.is_cut
    # The third and fourth affect the mailboxes of the first two, so the times that are planned for
    # those have passed in between.
    assert (begins[0], begins[2]) == (STRIKES, STRIKES + 190)
    assert STRIKES + 20 < begins[1] < 520
    assert begins[1] + 180 <= begins[3] < begins[2] + 300
    assert begins[3] + 20 < begins[4] < begins[3] + 200
    assert [strike.began for strike in trial.strikes] == [*begins]
    assert all(fault.seen == "detected" for fault in judge_trial(trial).faults)
    # Equal plans have equal trials.
    again = bench.run(plan)
    assert (again.begin_ticks, again.outcome) == (begins, trial.outcome)
    # A run with faults at these ticks is the same, and has the same verdicts.
    actual = judge_trial(trial).actual_plan
    assert [table["tick"] for table in actual.faults] == [*begins]
    whole = bench.run(actual, whole=True)
    assert {**verdict(trial), "plan": None} == {**verdict(whole), "plan": None}
    assert (whole.begin_ticks, judge_trial(whole).actual_plan) == ((), actual)


@pytest.mark.thorough
def test_the_faultless_rack_runs_only_as_far_as_necessary_and_equals_one_without_snapshots(
    bench: Bench,
) -> None:
    part = bench.base.run(bench.crate, 0.6)
    assert bench.base.run(bench.crate, 0.5) is part
    assert part.outcome is not None
    assert part.outcome.ticks == 240
    rest = bench.base.run(bench.crate, SECONDS)
    assert (rest.start.tick, bench.base.run(bench.crate, 1.0)) == (200, rest)
    whole = bench.run(NOMINAL, whole=True)
    assert rest.outcome is not None
    assert whole.outcome is not None
    assert (rest.outcome.digest, rest.left) == (whole.outcome.digest, ())
    assert [event.kind for event in rest.events].count("end") == 1


def test_trials_with_kills_from_outside_run_to_the_end(bench: Bench) -> None:
    plan = Plan(1, "kills", True, (), (Kill("lower", 600, 0.5),))
    found = bench.run(plan)
    assert not found.is_cut
    assert [strike.board for strike in found.strikes] == ["lower"]


def test_a_trial_that_cannot_continue_from_a_snapshot_says_why(bench: Bench) -> None:
    soon = Plan(1, "faults", False, (MUTE,))
    early = Plan(1, "faults", True, ({"kind": "self-test", "board": "lower"},))
    assert bench.base.find_start(soon, None) == Start(whole="real time")
    assert bench.base.find_start(early, bench.crate).whole == "a fault prevents the launch"


def test_a_rack_without_snapshots_runs_whole_trials(
    small: Path, rack_name: str, tmp_path: Path, crate: WarmCrate
) -> None:
    levels = tmp_path / "holding_levels.py"
    levels.write_text(
        "from socket import socket\nfrom two_levels import Lower as Plain\n\n\n"
        "class Lower(Plain):\n    def self_test(self):\n        self.held = socket()\n"
    )
    text = small.read_text().replace('two_levels:Lower"\nplanner', 'holding_levels:Lower"\nplanner')
    small.write_text(text.replace("python_path = [", f'python_path = ["{tmp_path}", '))
    trial = Bench(load(small), rack_name, crate).run(Plan(1, "faults", True, (MUTE,)))
    assert trial.start.whole.startswith("no snapshots: lower: it holds socket:")
    assert judge_trial(trial).shortfalls == ()
