"""The results of a campaign: trials with their verdicts, each kept in a file, and faultless
time."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from rack.boards.events import Event
from rack.boards.faults.kind import KINDS
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.statistics import rate
from rack.tools.faults.campaigns.trial import Trial
from rack.tools.faults.judge import Circumstances, FaultVerdict, Judgement, judge

Ended = Literal["task done", "safely stopped", "not armed", "neither"]
MISS = "miss"


@dataclass(frozen=True)
class Judged:
    """A trial and its verdict."""

    trial: Trial
    verdict: FaultVerdict

    @classmethod
    def of(cls, trial: Trial) -> Judged:
        """Judge a trial."""
        if trial.refused or trial.layout is None:
            return cls(trial, FaultVerdict(_refused(trial), ()))
        run = Circumstances(
            layout=trial.layout,
            offset_ns=trial.offset_ns,
            is_lockstep=trial.plan.lockstep,
            restart_s=trial.restart_s,
            has_failed=trial.outcome is not None and not trial.outcome.worked,
            moving=trial.moving,
        )
        return cls(trial, judge(trial.strikes, trial.events, run))

    @property
    def ended(self) -> Ended:
        """How the task ended; safely: with the arm at rest and no limit violated."""
        trial = self.trial
        outcome = self.trial.outcome
        if trial.refused:
            return "not armed" if self.is_to_be_refused else "neither"
        if outcome is None or outcome.cause == "stopped":
            return "neither"
        if outcome.worked:
            return "task done"
        return "safely stopped" if trial.arm.is_at_rest and not trial.arm.violations else "neither"

    @property
    def is_to_be_refused(self) -> bool:
        """Whether the rack must not launch with this plan."""
        return any(KINDS[table["kind"]].where == "start" for table in self.trial.plan.faults)

    @property
    def shortfalls(self) -> list[str]:
        """The shortfalls of the trial, a line each; empty for a good one."""
        trial = self.trial
        lines = [
            line for fault in self.verdict.faults if fault.is_judged for line in _shortfalls(fault)
        ]
        lines += [
            f"{e.board}: {e.text}: no fault explains it (tick {e.tick})"
            for e in self.verdict.unexplained
        ]
        lines += (
            [f"limits violated at {trial.arm.violations} substeps"] if trial.arm.violations else []
        )
        lines += [f"left behind: {thing}" for thing in trial.left]
        if self.ended == "neither":
            lines.append(f"the task is neither done nor safely stopped: {self._why_neither()}")
        if self.ended == "safely stopped" and not lines and not self._had_to_end:
            lines.append(f"the task is not done, and no fault had to end it: {self._why_neither()}")
        return lines

    @property
    def _had_to_end(self) -> bool:
        """Whether a fault had to end the task: it is latched, or reactions have taken the task's
        time."""
        faults = self.verdict.faults
        return any(f.is_latched for f in faults) or (
            self.trial.is_late and any(f.reactions for f in faults)
        )

    def _why_neither(self) -> str:
        trial = self.trial
        outcome = self.trial.outcome
        if trial.refused or outcome is None:
            return trial.refused or f"it does not end; {trial.levels}"
        return "; ".join(filter(None, [outcome.cause, *outcome.faults, trial.levels]))

    def result(self) -> TrialResult:
        """Return the part of the trial that is kept."""
        trial = self.trial
        outcome = self.trial.outcome
        return TrialResult(
            plan=trial.plan,
            ended=self.ended,
            ticks=outcome.ticks if outcome else 0,
            digest=outcome.digest if outcome else "",
            violations=trial.arm.violations,
            touches=trial.arm.touches,
            left=trial.left,
            wall_s=round(trial.wall_s, 3),
            notes=tuple(event.text for event in trial.events if event.kind == "ready"),
            misses=dict(Counter(event.code for event in trial.events if event.kind == MISS)),
            stray_misses=len(self.verdict.misses),
            faults=self.verdict.faults,
            unexplained=self.verdict.unexplained,
            shortfalls=tuple(self.shortfalls),
        )

    def document(self) -> dict[str, Any]:
        """Return the trial as plain data, with all that happened in it."""
        trial = self.trial
        outcome = self.trial.outcome
        return {
            "finding": asdict(self.result()),
            "outcome": asdict(outcome) if outcome else None,
            "refused": trial.refused,
            "levels": trial.levels,
            "events": [asdict(event) for event in trial.events],
        }


@dataclass(frozen=True)
class TrialResult:
    """The part of a trial that is kept, for the report of its campaign.

    `misses`: their number by code; `stray_misses`: those that no fault explains. `unexplained`:
    false detections.
    """

    plan: Plan
    ended: Ended
    ticks: int
    digest: str
    violations: int
    touches: int
    left: tuple[str, ...]
    wall_s: float
    notes: tuple[str, ...]
    misses: dict[str, int]
    stray_misses: int
    faults: tuple[Judgement, ...]
    unexplained: tuple[Event, ...]
    shortfalls: tuple[str, ...]


_KEPT = TypeAdapter(TrialResult)


def keep(judged: Judged, path: Path) -> None:
    """Write a trial to a file, which exists whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(judged.document()) + "\n")
    unfinished.replace(path)


def kept(path: Path) -> TrialResult | None:
    """Return the result that a file keeps; None where there is no file."""
    try:
        return _KEPT.validate_python(json.loads(path.read_text())["finding"])
    except FileNotFoundError:
        return None


@dataclass(frozen=True)
class Faultless:
    """Runs without faults in real time, `seconds` of simulated time, under `load`: a command, or ""
    for alone."""

    load: str
    seconds: float
    runs: tuple[TrialResult, ...]

    @property
    def trips(self) -> int:
        """False trips: detections, and boards that died of no fault."""
        return sum(len(run.unexplained) for run in self.runs)

    def document(self) -> dict[str, Any]:
        """Return the figures as plain data."""
        return {
            "load": self.load,
            "seconds": round(self.seconds, 3),
            "trips": self.trips,
            "trips_per_hour": rate(self.trips, self.seconds),
            "tripped": [asdict(event) for run in self.runs for event in run.unexplained],
            "misses": misses_of(self.runs),
        }


@dataclass
class Results:
    """Everything that a campaign has done. `nominal` is its faultless run in lockstep.

    `lacking`: lines about faults that did not strike, however often they were drawn.
    """

    nominal: TrialResult
    trials: list[TrialResult] = field(default_factory=list)
    sizes: list[TrialResult] = field(default_factory=list)
    faultless: list[Faultless] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    is_interrupted: bool = False

    @property
    def runs(self) -> list[TrialResult]:
        """All runs, of whatever purpose."""
        calm = [run for part in self.faultless for run in part.runs]
        return [self.nominal, *self.trials, *self.sizes, *calm]

    @property
    def faults(self) -> list[Judgement]:
        """The judgements of all trials, without the sweep of sizes."""
        return [fault for run in self.trials for fault in run.faults]


def misses_of(runs: Sequence[TrialResult]) -> dict[str, int]:
    """Return the number of misses by code: a busy machine explains them."""
    total: Counter[str] = Counter()
    for run in runs:
        total.update(run.misses)
    return dict(total)


def _refused(trial: Trial) -> tuple[Judgement, ...]:
    """Return the judgements of faults that prevent a launch: the refusal is their detection."""
    return tuple(_at_start(table["kind"], table["board"], trial) for table in trial.plan.faults)


def _at_start(kind: str, board: str, trial: Trial) -> Judgement:
    if KINDS[kind].where != "start":
        return Judgement(kind, board, -1, "not struck")
    is_found = f"'{board}'" in trial.refused
    return Judgement(
        kind=kind,
        board=board,
        struck=0,
        seen="detected" if is_found else "missed",
        found_by="the Rack",
        found_as="not armed",
        is_within=is_found,
        reactions=("not armed",),
        is_recovered=trial.again is not None and trial.again.worked,
    )


def _shortfalls(fault: Judgement) -> Iterator[str]:
    strike = (
        f"{fault.kind} of {fault.mailbox or fault.board}{' ' + fault.joint if fault.joint else ''}"
    )
    strike += f", struck at tick {fault.struck}"
    if fault.seen == "missed":
        yield f"{strike}: not detected"
    if fault.seen == "detected" and not fault.is_within:
        after = f"{fault.delay} ticks; bound {fault.bound}"
        if fault.bound_ms is not None:
            after = f"{fault.delay_ms:g} ms; bound {fault.bound_ms:g}"
        yield f"{strike}: {fault.found_as} by {fault.found_by} after {after}"
    yield from (f"{strike}: no {code.replace('_', ' ')} follows" for code in fault.lacking)
    if not fault.is_recovered:
        undone = (
            f"undone after {fault.recovery} ticks" if fault.recovery is not None else "never undone"
        )
        yield (
            f"{strike}: {', '.join(fault.reactions) or 'loss of messages'} {undone}; bound"
            f" {fault.recovery_bound}"
        )
