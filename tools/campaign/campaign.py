"""A campaign: a faultless run, trials with faults, kills, sizes, and faultless time, one after the other."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from backplane.layout import Layout
from boards.config import wire
from boards.config.schema import RackConfig
from boards.faults.request import injections
from tools.answer import Failure
from tools.campaign.draw import Course, fault_plans, kill_plans, size_plans
from tools.campaign.interrupt import Interrupt
from tools.campaign.load import cpu_load
from tools.campaign.plan import Plan
from tools.campaign.results import Faultless, Judged, Results
from tools.campaign.targets import Targets, kinds_for
from tools.campaign.trial import run_trial
from tools.progress import Progress

LAUNCH_S = 2.0
"""What a launch and an end take, about: the progress bar's guess."""
RESTART_S = 2.0
"""What a restart takes in real time, at most."""
SHORTEST_S = 1.0
"""Faultless time is not cut finer."""


@dataclass(frozen=True)
class Order:
    """What a campaign is asked for. `modes` are True for lockstep, by turns; `seconds`: of a rack that no task ends."""

    name: str
    config: RackConfig
    runs: int
    seed: int
    modes: tuple[bool, ...]
    kinds: str | None = None
    kills: int = 0
    sizes: int = 0
    faultless_s: float = 0.0
    seconds: float | None = None


class Campaign:
    """One campaign. Raises `ConfigError`, and `Failure` for a task that is not done even without faults."""

    def __init__(self, order: Order, folder: Path, progress: Progress, interrupt: Interrupt) -> None:
        self.order, self.folder = order, folder
        self._progress, self._interrupt = progress, interrupt
        self._rack = f"camp-{os.getpid()}x"
        # Its own faults alone: a config's own ones would strike every trial.
        self._config = order.config.model_copy(update={"fault": ()})
        self.layout: Layout = wire(self._config)
        self._second = 1e9 / self._config.clock_ns
        targets = Targets(self._config, self.layout)
        self.kinds = kinds_for(order.kinds, targets, True in order.modes, False in order.modes)
        self._targets = targets
        self._ticks = round((order.seconds or 0.0) * self._second)

    def run(self) -> Results:
        """Do everything, or what there is time for until Ctrl-C."""
        self._progress.begin("without faults, in lockstep")
        nominal = self._judged(Plan(0, "nominal", lockstep=True))
        if nominal.ended != "task done" and not self._interrupt.is_set:
            raise Failure(f"{self.order.name}: not done even without faults: {'; '.join(nominal.shortfalls)}")
        results = Results(nominal)
        self._ticks = nominal.trial.outcome.ticks if nominal.trial.outcome else self._ticks
        trials, sizes = self._plans()
        self._progress.total(self._guess_s([*trials, *sizes]) + 2 * self.order.faultless_s)
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "trials.jsonl").open("w", buffering=1) as log:
            for plans, found in ((trials, results.trials), (sizes, results.sizes)):
                for judged in self._trials(plans):
                    found.append(judged)
                    log.write(json.dumps(judged.document()) + "\n")
        self._faultless(results)
        results.is_interrupted = self._interrupt.is_set
        return results

    def _plans(self) -> tuple[list[Plan], list[Plan]]:
        """Return the plans of trials and of the sweep of sizes; all of them fit the config."""
        order, course = self.order, Course(self._targets, self._ticks, self._second, self._restart_s())
        modes = [order.modes[place % len(order.modes)] for place in range(order.runs)]
        trials = list(fault_plans(course, self.kinds, order.seed, modes))
        trials += kill_plans(course, order.kills, order.seed, order.modes, len(trials) + 1)
        sizes = list(size_plans(course, self.kinds, order.sizes, order.seed, len(trials) + 1))
        for plan in (*trials, *sizes):
            injections(plan.config(self._config, self._rack), self.layout)
        return trials, sizes

    def _restart_s(self) -> float:
        in_lockstep = self._config.supervision.lockstep_restart_s
        return in_lockstep if False not in self.order.modes else max(RESTART_S, in_lockstep)

    def _trials(self, plans: list[Plan]) -> Iterator[Judged]:
        for place, plan in enumerate(plans, 1):
            if self._interrupt.is_set:
                return
            self._progress.begin(f"trial {place} of {len(plans)}: {_told(plan)}")
            judged = self._judged(plan)
            if judged.trial.is_interrupted:
                return
            shortfalls = judged.shortfalls
            if shortfalls:
                (self.folder / f"trial-{plan.number:03}.toml").write_text(plan.toml(self.order.name))
            self._progress.end(self._guess_s([plan]), judged.ended, shortfalls)
            yield judged

    def _faultless(self, results: Results) -> None:
        """Run without faults, first alone, then beside busy processes."""
        for loaded in (False, True) if self.order.faultless_s else ():
            with ExitStack() as stack:
                load = stack.enter_context(cpu_load()) if loaded else 0
                judged, total = [], 0.0
                while (left := self.order.faultless_s - total) >= SHORTEST_S and not self._interrupt.is_set:
                    beside = f" beside {load} busy processes" if load else ""
                    self._progress.begin(f"faultless{beside}, {left:.0f} s to go")
                    seconds = left if left < self._ticks / self._second else self.order.seconds
                    run = self._judged(Plan(0, "faultless", lockstep=False), seconds)
                    if run.trial.is_interrupted:
                        break
                    judged.append(run)
                    # A run that has not come to an end would come to none the next time either.
                    ran_s = run.trial.outcome.ticks / self._second if run.trial.outcome else left
                    total += ran_s
                    self._progress.end(ran_s, run.ended, run.shortfalls)
                results.faultless.append(Faultless(load, total, tuple(judged)))

    def _judged(self, plan: Plan, seconds: float | None = None) -> Judged:
        seconds = self.order.seconds if seconds is None else seconds
        return Judged.of(run_trial(self._config, plan, self._rack, self._ticks, seconds, self._interrupt))

    def _guess_s(self, plans: Sequence[Plan]) -> float:
        """Return about how long runs take: in lockstep a second of the default rack takes a third of one."""
        real_s = self._ticks / self._second
        return sum(LAUNCH_S + (real_s / 3.0 if plan.lockstep else real_s) for plan in plans)


def _told(plan: Plan) -> str:
    faults = [f"{table['kind']} {table.get('mailbox') or table['board']}" for table in plan.faults]
    kills = [f"{kill.board}" for kill in plan.kills]
    told = [*faults, *([f"external kills of {', '.join(kills)}"] if kills else [])]
    return f"{'lockstep' if plan.lockstep else 'real time'}: {', '.join(told)}"
