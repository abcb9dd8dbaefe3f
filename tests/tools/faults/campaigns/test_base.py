"""Trials that go on from the faultless run have the verdicts of whole ones, and say where they
begin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from rack.boards.config import RackConfig, load, wire
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import CheckpointError
from rack.boards.faults.kind import KINDS
from rack.tools.faults.campaigns import base as base_run
from rack.tools.faults.campaigns import trial as trials
from rack.tools.faults.campaigns.base import BaseRun, Start
from rack.tools.faults.campaigns.draw import RackUnderTest, fault_plans
from rack.tools.faults.campaigns.plan import Kill, Plan, Targets, needs_real_time
from rack.tools.faults.campaigns.results import result_of
from rack.tools.faults.campaigns.trial import Trial, run_trial

NOMINAL = Plan(0, "nominal", lockstep=True)
SECONDS = 5.0
STRIKES = 330
BEFORE = 300
MOVES = 1130
MUTE = {"kind": "mute", "board": "lower", "tick": STRIKES, "for": "50ms"}
OF_ONE_RUN = ("wall_s", "notes", "start", "whole")
"""Fields of a result that are not of the verdict."""


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base_run, "EVERY_S", 0.25)


@pytest.fixture
def crate() -> Iterator[WarmCrate]:
    with WarmCrate() as crate:
        yield crate


class Bench:
    """One rack's trials, whole or from its faultless run."""

    def __init__(self, config: RackConfig, name: str, base: BaseRun, crate: WarmCrate) -> None:
        self.base = base
        self._given = config.model_copy(update={"fault": ()}), name
        self._crate = crate
        nominal = self.run(NOMINAL)
        assert not nominal.refused
        base.keep(nominal.events)

    def run(self, plan: Plan, whole: bool = False, seconds: float = SECONDS) -> Trial:
        """Run a plan."""
        config, name = self._given
        base = None if whole else self.base
        return run_trial(config, plan, name, 0, seconds, base=base, crate=self._crate)


def verdict(trial: Trial) -> dict[str, Any]:
    """Return all that is judged of a trial, and what was written in it."""
    found = {key: value for key, value in asdict(result_of(trial)).items() if key not in OF_ONE_RUN}
    found["unexplained"] = [replace(e, time_ns=0) for e in result_of(trial).unexplained]
    found["outcome"] = trial.outcome and asdict(trial.outcome)
    found["levels"] = trial.levels
    return found


def one_of_each(config: RackConfig, kinds: Sequence[str]) -> list[Plan]:
    """Return a plan for each kind, with one fault at a place that a campaign draws, while the arm
    moves."""
    targets = Targets(config, wire(config))
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
    rack_name: str, tmp_path: Path, crate: WarmCrate
) -> None:
    config = load("nasrem").model_copy(update={"fault": ()})
    targets = Targets(config, wire(config)).by_kind
    kinds = [kind for kind, at in targets.items() if at and not needs_real_time(kind)]
    # All that there are in lockstep; only a hand has tendons.
    others = {kind.name for kind in KINDS if not kind.realtime} - set(kinds)
    assert others == {"tendon-torn"}
    with BaseRun(config, tmp_path / "base") as base:
        bench = Bench(config, rack_name, base, crate)
        idle = set[str]()
        for plan in one_of_each(config, kinds):
            continued = bench.run(plan)
            whole = bench.run(plan, whole=True)
            assert verdict(continued) == verdict(whole), plan
            assert (whole.start.tick, whole.start.whole) == (0, "as asked")
            (fault,) = result_of(continued).faults
            if not plan.first:
                assert (continued.start.tick, fault.found_as) == (0, "not armed")
                continue
            assert continued.start.tick == MOVES - 30
            if fault.struck < plan.first:
                idle.add(fault.kind)
    # The others have been something to judge.
    assert len(idle) <= 3, idle


@pytest.fixture
def bench(small: Path, rack_name: str, tmp_path: Path, crate: WarmCrate) -> Iterator[Bench]:
    config = load(small)
    with BaseRun(config, tmp_path / "base") as base:
        yield Bench(config, rack_name, base, crate)


@pytest.mark.slow
def test_a_trial_starts_at_the_last_checkpoint_before_its_first_fault(bench: Bench) -> None:
    early = {**MUTE, "tick": 520}
    kill = Kill("lower", 600, 0.5)
    plan = Plan(1, "faults", True, (early, MUTE), (kill,))
    assert bench.base.start_of(plan).tick == BEFORE
    at_it = replace(plan, faults=({**MUTE, "tick": BEFORE},), kills=())
    assert bench.base.start_of(at_it).tick == BEFORE
    killed = replace(plan, faults=())
    assert (killed.first, bench.base.start_of(killed).tick) == (600, 600)
    assert verdict(bench.run(at_it)) == verdict(bench.run(at_it, whole=True))


@pytest.mark.slow
def test_what_cannot_start_at_a_checkpoint_says_why(bench: Bench) -> None:
    soon = Plan(1, "faults", True, ({**MUTE, "tick": 99},))
    assert bench.base.start_of(soon) == Start(
        whole="first fault at tick 99, first checkpoint at 100"
    )
    assert bench.base.start_of(replace(soon, lockstep=False)) == Start(whole="real time")
    found = result_of(bench.run(soon))
    assert (found.start, found.whole) == (0, "first fault at tick 99, first checkpoint at 100")


@pytest.mark.slow
def test_a_rack_without_checkpoints_runs_whole_trials(
    small: Path, rack_name: str, tmp_path: Path, crate: WarmCrate
) -> None:
    levels = tmp_path / "holding_levels.py"
    levels.write_text(
        "from threading import Lock\nfrom two_levels import Lower as Plain\n\n\n"
        "class Lower(Plain):\n    def self_test(self):\n        self.held = Lock()\n"
    )
    text = small.read_text().replace('two_levels:Lower"\nplanner', 'holding_levels:Lower"\nplanner')
    small.write_text(text.replace("python_path = [", f'python_path = ["{tmp_path}", '))
    config = load(small)
    with BaseRun(config, tmp_path / "base") as base:
        bench = Bench(config, rack_name, base, crate)
        trial = bench.run(Plan(1, "faults", True, (MUTE,)))
    assert trial.start.whole.startswith("no checkpoints: lower.executor.held: a _thread.lock")
    assert result_of(trial).shortfalls == ()


@pytest.mark.slow
def test_a_checkpoint_that_does_not_fit_is_given_up_and_the_trial_runs_whole(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Plan(1, "faults", True, (MUTE,))
    for path in bench.base._kept.values():
        path.write_bytes(path.read_bytes()[:-1])
    trial = bench.run(plan)
    assert trial.start.whole.endswith("was cut off or changed: its checksum is wrong")
    assert verdict(trial) == verdict(bench.run(plan, whole=True))
    # For good.
    assert bench.base.start_of(plan).whole == trial.start.whole

    def refuse(*given: object, **more: object) -> None:
        raise CheckpointError("never")

    monkeypatch.setattr(trials, "Rack", refuse)
    with pytest.raises(CheckpointError, match="never"):
        bench.run(plan)


def test_the_folder_of_the_run_is_there_as_long_as_the_context(small: Path, tmp_path: Path) -> None:
    folder = tmp_path / "base"
    folder.mkdir()
    # Left by a campaign that was killed.
    (folder / "old").touch()
    with BaseRun(load(small), folder) as base:
        assert list(base.folder.iterdir()) == []
    assert not folder.exists()
