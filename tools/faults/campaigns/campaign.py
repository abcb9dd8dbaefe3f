"""A campaign: a faultless run, trials with faults, kills and sizes, and faultless time; each run
leaves a file.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from rack.backplane.json_text import encode_json
from rack.backplane.layout import Layout
from rack.boards.config import wire
from rack.boards.config.schema import RackConfig
from rack.tools.console.answer import Document, Failure, write_json
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.progress import Progress
from rack.tools.faults.campaigns.draw import RackUnderTest, fault_plans, kill_plans, size_plans
from rack.tools.faults.campaigns.environment import examine, load
from rack.tools.faults.campaigns.plan import Plan, Targets, kinds_for, needs_real_time
from rack.tools.faults.campaigns.results import Faultless, Results, TrialResult, kept
from rack.tools.faults.campaigns.workers import TrialJob, Workers
from rack.tools.faults.ending import EXTERNAL, record_of

LAUNCH_S = 2.0
"""About the time of a launch and an end, for the progress bar."""
SHORTEST_S = 1.0
"""Shortest run of faultless time."""
ROUNDS = 8
"""Rounds in which faults that do not strike are drawn again, at other instants; then they are
missing."""
MOST_AGAIN = 4
"""Draws of one fault in a round, at most: more from round to round, since the fewer are left, the
less does one more cost."""
ORDER = "order.json"
TRIALS = "trials"
"""In a campaign's folder: the file with its order, and the folder of its trials."""
NOMINAL = Plan(0, "nominal", lockstep=True)


@dataclass(frozen=True)
class Order:
    """An order for a campaign. `injections` of each kind; `modes` are True for lockstep, in their
    order.

    `seconds`: simulated time of a rack that no task ends. `loads`: for each stretch of faultless
    time, whether the machine is loaded.
    """

    name: str
    config: RackConfig
    injections: int
    seed: int
    modes: tuple[bool, ...]
    kinds: str | None = None
    kills: int = 0
    sizes: int = 0
    faultless_s: float = 0.0
    loads: tuple[bool, ...] = (False, True)
    seconds: float | None = None

    def document(self) -> Document:
        """Return the order as plain data: equal for campaigns that are the same."""
        return {**vars(self), "config": self.config.text()}


class Campaign:
    """One campaign; with `whole`, no trial goes on from a snapshot. Raises `ConfigError`, and
    `Failure` for a task that is not done even without faults.
    """

    def __init__(self, order: Order, folder: Path, progress: Progress, whole: bool = False) -> None:
        self.order = order
        self.folder = folder
        self._progress = progress
        # Only the campaign's faults: the config's own would strike every trial. Misses are counted.
        unjudged = order.config.supervision.model_copy(update={"max_missed_fraction": 1.0})
        self._config = order.config.model_copy(update={"fault": (), "supervision": unjudged})
        self.layout: Layout = wire(self._config)
        self._second = 1e9 / self._config.clock_ns
        self._targets = Targets(self._config, self.layout)
        self.kinds = kinds_for(order.kinds, self._targets, False in order.modes)
        self._ticks = 0
        self._number = 0
        self._whole = whole

    def run(self) -> Results:
        """Do everything that is not done yet, or as much as there is time for until Ctrl-C."""
        order = self.order
        self._open()
        examine(self._config)
        with Workers(self._config, self._whole) as self._workers:
            self._progress.begin("without faults, in lockstep")
            made = self._made([NOMINAL])
            if not made:
                raise Failure(f"{order.name}: interrupted before the first run was done")
            nominal = made[0]
            if nominal.shortfalls or nominal.ended != "task done":
                why = "; ".join(nominal.shortfalls)
                raise Failure(f"{order.name}: the task is not done even without faults: {why}")
            self._ticks = nominal.ticks
            results = Results(nominal)
            for lockstep in order.modes:
                self._inject(results, lockstep)
            # Runs of kills alternate between the modes.
            rack = self._under_test(False not in order.modes)
            kills = kill_plans(rack, order.kills, order.seed, order.modes, self._number + 1)
            results.trials += self._made(kills)
            rack = self._under_test(True)
            sizes = size_plans(rack, self.kinds, order.sizes, order.seed, self._number + 1)
            results.sizes += self._made(sizes)
            self._run_faultless(results)
        results.is_interrupted = INTERRUPT.number != 0
        return results

    def _open(self) -> None:
        """Make the folder, or continue in it. Raises `Failure` where it is another campaign's."""
        path = self.folder / ORDER
        wanted = json.loads(encode_json(self.order.document()))
        if path.exists():
            there = json.loads(path.read_text())
            if other := [key for key in wanted if wanted[key] != there.get(key)]:
                differing = ", ".join(key.replace("_", " ") for key in other)
                raise Failure(
                    f"--out {self.folder}: holds another campaign; it differs in {differing}", 2
                )
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(path, wanted)

    def _under_test(self, lockstep: bool) -> RackUnderTest:
        restart = self._config.supervision.restart_s(lockstep)
        return RackUnderTest(self._targets, self._ticks, self._second, restart)

    def _inject(self, results: Results, lockstep: bool) -> None:
        """Make trials until every kind has struck as often as ordered."""
        order = self.order
        kinds = self.kinds
        if lockstep or len(order.modes) > 1:
            # Real time repeats nothing that lockstep can have.
            kinds = [kind for kind in kinds if needs_real_time(kind) != lockstep]
        # Unary plus leaves out the kinds that lack nothing.
        lacking = +Counter(dict.fromkeys(kinds, order.injections))
        rack = self._under_test(lockstep)
        tried = set[str]()
        # Faults that have trials of their own come later: what is drawn again leaves cores free.
        now = [kind for kind in lacking if record_of(kind).recoverable] or list(lacking)
        for turn in range(ROUNDS):
            seed = f"{order.seed} {turn}"
            again = min(turn + 1, MOST_AGAIN)
            counts = {kind: lacking[kind] * (again if kind in tried else 1) for kind in now}
            found = self._made(fault_plans(rack, counts, seed, lockstep, self._number + 1))
            results.trials += found
            faults = [fault for run in found for fault in run.faults]
            lacking -= Counter(f.kind for f in faults if f.is_judged and f.seen != "not struck")
            if not lacking or INTERRUPT.number:
                break
            tried.update(now)
            now = list(lacking)
        wanted = order.injections
        results.lacking += [
            f"{kind}: struck {wanted - count} of {wanted} times, in {ROUNDS} rounds"
            for kind, count in lacking.items()
        ]

    def _made(self, plans: Sequence[Plan]) -> list[TrialResult]:
        """Return the results of these plans, in their order: made now, or kept from before."""
        self._number = max([self._number, *(plan.number for plan in plans)])
        if plans:
            self._progress.total(self._guess_s(plans))
        jobs = [self._job(plan) for plan in plans]
        for lockstep in (True, False):
            waiting = [job for job in jobs if job.plan.lockstep is lockstep and not _kept(job)]
            if waiting:
                mode = "lockstep" if lockstep else "real time"
                self._progress.begin(f"{len(waiting)} in {mode}")
            for job in self._workers.run(waiting, alone=not lockstep):
                self._show(job)
        return [found for job in jobs if (found := _kept(job))]

    def _job(self, plan: Plan) -> TrialJob:
        name = f"{plan.number:04}" if plan.number else plan.purpose
        path = self.folder / TRIALS / f"{name}.json"
        return TrialJob(plan, path, self._ticks, self.order.seconds)

    def _show(self, job: TrialJob) -> None:
        """Show how a trial ended; where it falls short, leave a plan that repeats it."""
        plan = job.plan
        if (found := _kept(job)) is None:
            return
        if found.shortfalls and plan.number:
            path = self.folder / f"trial-{plan.number:04}.toml"
            path.write_text(plan.toml(self.order.name))
        ended = f"{_text(plan)}: {found.ended}"
        self._progress.end(self._guess_s([plan]), ended, found.shortfalls)

    def _run_faultless(self, results: Results) -> None:
        """Run without faults, alone or under load, for as long as ordered."""
        if not self.order.faultless_s:
            return
        for place, is_loaded in enumerate(self.order.loads):
            if INTERRUPT.number:
                return
            burden = load() if is_loaded else nullcontext("")
            with burden as under:
                runs = tuple(self._calm(place, under))
            seconds = sum(run.ticks for run in runs) / self._second
            results.faultless.append(Faultless(under, seconds, runs))

    def _calm(self, place: int, under: str) -> Iterator[TrialResult]:
        """Yield faultless runs in real time."""
        faultless = self._job(Plan(0, "faultless", lockstep=False))
        name = f"faultless under {under}" if under else "faultless"
        left = self.order.faultless_s
        nth = 0
        while left >= SHORTEST_S and not INTERRUPT.number:
            self._progress.begin(f"{name}, {left:.0f} s left")
            seconds = left if left < self._ticks / self._second else self.order.seconds
            path = faultless.path.with_stem(f"faultless-{place}-{nth:03}")
            job = replace(faultless, path=path, seconds=seconds)
            if _kept(job) is None:
                list(self._workers.run([job], alone=True))
            if (found := _kept(job)) is None:
                return
            yield found
            # A run that has not ended would not end the next time either.
            ran_s = found.ticks / self._second or left
            left -= ran_s
            nth += 1
            self._progress.end(ran_s, found.ended, found.shortfalls)

    def _guess_s(self, plans: Sequence[Plan]) -> float:
        """Estimate the time that runs take: in lockstep a core simulates the default rack in a
        third of real time.
        """
        real_s = self._ticks / self._second
        lockstep_s = real_s / 3.0 / len(os.sched_getaffinity(0))
        run_s = {True: lockstep_s, False: real_s}
        return sum(LAUNCH_S + run_s[plan.lockstep] for plan in plans)


def _kept(job: TrialJob) -> TrialResult | None:
    """Return the result that is kept of a trial; None for one of another plan, drawn by another
    version.
    """
    found = kept(job.path)
    return found if found is not None and found.plan == job.plan else None


def _text(plan: Plan) -> str:
    """Return a plan in a few words."""
    if not plan.number:
        return plan.purpose
    kinds = Counter([*(table["kind"] for table in plan.faults), *[EXTERNAL] * len(plan.kills)])
    counts = [f"{count} {kind}".removeprefix("1 ") for kind, count in kinds.items()]
    return f"{plan.name}, {', '.join(counts)}"
