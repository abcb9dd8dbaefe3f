"""A campaign: a faultless run, trials with faults, kills and sizes, and faultless time.

Each run leaves a file, so that a campaign can be continued.
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
from rack.boards.config import resolve_layout
from rack.boards.config.schema import RackConfig
from rack.tools.console.answer import Document, Failure, write_json
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.progress import Progress
from rack.tools.faults.campaigns.draw import (
    MAX_FAULTS,
    RackUnderTest,
    fault_plans,
    kill_plans,
    size_plans,
)
from rack.tools.faults.campaigns.environment import check_violation_counter, run_load
from rack.tools.faults.campaigns.plan import (
    NOMINAL,
    Plan,
    Targets,
    needs_real_time,
    select_kinds,
    strike_active_copies,
)
from rack.tools.faults.campaigns.results import FaultlessTime, Results, TrialResult, load_result
from rack.tools.faults.campaigns.workers import TrialJob, Workers
from rack.tools.faults.ending import EXTERNAL, find_record

LAUNCH_S = 2.0
"""Approximate time in s to launch and end a rack, for the progress bar."""
SHORTEST_S = 1.0
"""Shortest run of faultless time."""
ROUNDS = 8
"""Number of rounds in which faults that did not act are drawn again before they are given up."""
MAX_DRAWS = 4
"""Maximum number of draws for one missing fault in a round.

The number grows from round to round: the fewer faults are missing, the less an extra draw costs.
"""
ORDER = "order.json"
TRIALS = "trials"
"""Names of the file with the order, and of the folder of trials, in a campaign's folder."""


@dataclass(frozen=True)
class Order:
    """Specification of a campaign.

    Attributes:
        name: Name of the config, for reports.
        config: Config of the rack.
        injections: Number of faults of each kind.
        seed: Seed of all random choices.
        modes: Clock modes in their order, True for lockstep.
        kinds: Kinds, separated by commas. None for all.
        kills: Number of external kills.
        sizes: Number of sizes for each curve of size against detection delay.
        faultless_s: Simulated time in s without faults, for each entry of `loads`.
        loads: Whether the machine is loaded, for each stretch of faultless time.
        seconds: Simulated time in s after which a run ends if no task ends it.
        board: The only board that faults affect. Empty for all.
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
    board: str = ""

    def to_document(self) -> Document:
        """Return the specification as plain data. Equal campaigns have equal documents."""
        return {**vars(self), "config": self.config.to_toml_text()}


class Campaign:
    """Runs one campaign.

    Args:
        order: Specification of the campaign.
        folder: Folder of the campaign.
        progress: Progress display.
        whole: Whether every trial runs from tick 0 instead of continuing from a snapshot.

    Raises:
        ConfigError: The config has mistakes.
        Failure: A kind in the specification is unknown, or the rack cannot have it.
    """

    def __init__(self, order: Order, folder: Path, progress: Progress, whole: bool = False) -> None:
        self.order = order
        self.folder = folder
        self._progress = progress
        # Drop the config's faults, which would act in every trial. Permit any number of misses.
        # All faults of a trial may strike one board, which is restarted each time.
        permitted = {"max_missed_fraction": 1.0} | ({"restarts": MAX_FAULTS} if order.board else {})
        unjudged = order.config.supervision.model_copy(update=permitted)
        self._config = order.config.model_copy(update={"fault": (), "supervision": unjudged})
        self.layout: Layout = resolve_layout(self._config)
        self._second = 1e9 / self._config.clock_ns
        self._targets = Targets(self._config, self.layout, order.board)
        self.kinds = select_kinds(order.kinds, self._targets, False in order.modes)
        self._ticks = 0
        self._number = 0
        self._whole = whole

    def run(self) -> Results:
        """Run every trial that has no result yet, until all are done or Ctrl-C is pressed.

        Raises:
            Failure: The task is not done even without faults, or another campaign uses the folder.
        """
        order = self.order
        self._open_folder()
        with Workers(self._config, self._whole) as self._workers:
            check_violation_counter(self._config)
            self._progress.begin_run("without faults, in lockstep")
            nominal_runs = self._run_plans([NOMINAL])
            if not nominal_runs:
                raise Failure(f"{order.name}: interrupted before the first run was done")
            nominal = nominal_runs[0]
            if nominal.shortfalls or nominal.ended != "task done":
                why = "; ".join(nominal.shortfalls)
                raise Failure(f"{order.name}: the task is not done even without faults: {why}")
            self._ticks = nominal.ticks
            results = Results(nominal)
            for lockstep in order.modes:
                self._run_fault_trials(results, lockstep)
            # Trials of kills alternate between lockstep and real time.
            rack = self._describe_rack(False not in order.modes)
            kills = kill_plans(rack, order.kills, order.seed, order.modes, self._number + 1)
            results.trials += self._run_plans(kills)
            rack = self._describe_rack(True)
            sizes = size_plans(rack, self.kinds, order.sizes, order.seed, self._number + 1)
            results.sizes += self._run_plans(sizes)
            self._run_faultless(results)
        results.is_interrupted = INTERRUPT.number != 0
        return results

    def _open_folder(self) -> None:
        """Create the folder, or reuse it if it belongs to the same campaign.

        Raises:
            Failure: The folder belongs to another campaign.
        """
        path = self.folder / ORDER
        wanted = json.loads(encode_json(self.order.to_document()))
        if path.exists():
            stored = json.loads(path.read_text())
            if differing_keys := [key for key in wanted if wanted[key] != stored.get(key)]:
                differing = ", ".join(key.replace("_", " ") for key in differing_keys)
                raise Failure(
                    f"--out {self.folder} belongs to a campaign that differs in {differing}",
                    2,
                )
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(path, wanted)

    def _describe_rack(self, lockstep: bool) -> RackUnderTest:
        """Return the facts about the rack that are needed to draw plans."""
        restart = self._config.supervision.find_restart_time(lockstep)
        return RackUnderTest(self._targets, self._ticks, self._second, restart)

    def _run_fault_trials(self, results: Results, lockstep: bool) -> None:
        """Run trials until every kind has acted as often as specified, or for `ROUNDS` rounds."""
        order = self.order
        kinds = self.kinds
        if lockstep or len(order.modes) > 1:
            # In real time, run only kinds that are impossible in lockstep.
            kinds = [kind for kind in kinds if needs_real_time(kind) != lockstep]
        # Unary plus removes kinds with a count of 0.
        lacking = +Counter(dict.fromkeys(kinds, order.injections))
        rack = self._describe_rack(lockstep)
        tried = set[str]()
        # Begin with faults that can share a trial. Later rounds have fewer trials and free cores.
        round_kinds = [kind for kind in lacking if find_record(kind).recoverable] or list(lacking)
        for turn in range(ROUNDS):
            seed = f"{order.seed} {turn}"
            draws = min(turn + 1, MAX_DRAWS)
            counts = {kind: lacking[kind] * (draws if kind in tried else 1) for kind in round_kinds}
            plans = fault_plans(rack, counts, seed, lockstep, self._number + 1)
            if order.board:
                plans = strike_active_copies(plans, self.layout, order.board)
            results_of_round = self._run_plans(plans)
            results.trials += results_of_round
            faults = [fault for run in results_of_round for fault in run.faults]
            lacking -= Counter(
                fault.kind for fault in faults if fault.is_judged and fault.seen != "not struck"
            )
            if not lacking or INTERRUPT.number:
                break
            tried.update(round_kinds)
            round_kinds = list(lacking)
        wanted = order.injections
        results.lacking += [
            f"{kind} acted only {wanted - count} of {wanted} times in {ROUNDS} rounds"
            for kind, count in lacking.items()
        ]

    def _run_plans(self, plans: Sequence[Plan]) -> list[TrialResult]:
        """Run the plans that have no saved result. Return the results of all, in their order."""
        self._number = max([self._number, *(plan.number for plan in plans)])
        if plans:
            self._progress.set_total(self._estimate_s(plans))
        jobs = [self._build_job(plan) for plan in plans]
        for lockstep in (True, False):
            waiting = [
                job
                for job in jobs
                if job.plan.lockstep is lockstep and not _load_matching_result(job)
            ]
            if waiting:
                mode = "lockstep" if lockstep else "real time"
                self._progress.begin_run(f"{len(waiting)} in {mode}")
            for job in self._workers.run(waiting, alone=not lockstep):
                self._show_result(job)
        return [result for job in jobs if (result := _load_matching_result(job))]

    def _build_job(self, plan: Plan) -> TrialJob:
        """Return the job that carries out a plan."""
        name = f"{plan.number:04}" if plan.number else plan.purpose
        path = self.folder / TRIALS / f"{name}.json"
        return TrialJob(plan, path, self._ticks, self.order.seconds)

    def _show_result(self, job: TrialJob) -> None:
        """Show how a trial ended. If it has shortfalls, write a file for repeating its faults."""
        plan = job.plan
        if (result := _load_matching_result(job)) is None:
            return
        if result.shortfalls and plan.number:
            path = self.folder / f"trial-{plan.number:04}.toml"
            path.write_text(result.actual_plan.format_faults(self.order.name))
        text = f"{_describe_plan(plan)}: {result.ended}"
        self._progress.end_run(self._estimate_s([plan]), text, result.shortfalls)

    def _run_faultless(self, results: Results) -> None:
        """Run without faults for the specified time, with and without load."""
        if not self.order.faultless_s:
            return
        for stretch, is_loaded in enumerate(self.order.loads):
            if INTERRUPT.number:
                return
            burden = run_load() if is_loaded else nullcontext("")
            with burden as load_text:
                runs = tuple(self._run_faultless_stretch(stretch, load_text))
            seconds = sum(run.ticks for run in runs) / self._second
            results.faultless.append(FaultlessTime(load_text, seconds, runs))

    def _run_faultless_stretch(self, stretch: int, load_text: str) -> Iterator[TrialResult]:
        """Yield results of faultless real-time runs until their total time is as specified.

        Args:
            stretch: Index of the stretch of faultless time.
            load_text: Description of the load. Empty without load.
        """
        faultless = self._build_job(Plan(0, "faultless", lockstep=False))
        name = f"faultless under {load_text}" if load_text else "faultless"
        left_s = self.order.faultless_s
        run_number = 0
        while left_s >= SHORTEST_S and not INTERRUPT.number:
            self._progress.begin_run(f"{name}, {left_s:.0f} s left")
            seconds = left_s if left_s < self._ticks / self._second else self.order.seconds
            path = faultless.path.with_stem(f"faultless-{stretch}-{run_number:03}")
            job = replace(faultless, path=path, seconds=seconds)
            if _load_matching_result(job) is None:
                list(self._workers.run([job], alone=True))
            if (result := _load_matching_result(job)) is None:
                return
            yield result
            # A run without ticks has failed and would fail again, so do not repeat it.
            ran_s = result.ticks / self._second or left_s
            left_s -= ran_s
            run_number += 1
            self._progress.end_run(ran_s, result.ended, result.shortfalls)

    def _estimate_s(self, plans: Sequence[Plan]) -> float:
        """Estimate how long the runs of plans take, in s of real time.

        In lockstep a core simulates the default rack in about a third of real time.
        """
        real_s = self._ticks / self._second
        lockstep_s = real_s / 3.0 / len(os.sched_getaffinity(0))
        run_s = {True: lockstep_s, False: real_s}
        return sum(LAUNCH_S + run_s[plan.lockstep] for plan in plans)


def run_campaign(
    order: Order, folder: Path, progress: Progress, whole: bool
) -> tuple[tuple[Campaign, Results], ...]:
    """Run one campaign, and return it with its results. See `Campaign`."""
    campaign = Campaign(order, folder, progress, whole)
    return ((campaign, campaign.run()),)


def _load_matching_result(job: TrialJob) -> TrialResult | None:
    """Return the saved result of a trial. None if it is missing or belongs to another plan.

    Another version of this program may have drawn another plan for the same trial number.
    """
    result = load_result(job.path)
    return result if result is not None and result.plan == job.plan else None


def _describe_plan(plan: Plan) -> str:
    """Return the name of a plan and the number of its faults of each kind."""
    if not plan.number:
        return plan.purpose
    kinds = Counter([*(table["kind"] for table in plan.faults), *[EXTERNAL] * len(plan.kills)])
    counts = [f"{count} {kind}".removeprefix("1 ") for kind, count in kinds.items()]
    return f"{plan.name}, {', '.join(counts)}"
