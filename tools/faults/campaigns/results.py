"""The results of a campaign: trials as judged, each kept in a file, and faultless time."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import TypeAdapter

from rack.boards.events import Event
from rack.boards.faults.kind import KINDS
from rack.tools.console.answer import Document, write_json
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.statistics import EventRate, rate
from rack.tools.faults.campaigns.trial import Trial
from rack.tools.faults.judge import FaultVerdict, Judgement, Seen, judge

Ended = Literal["task done", "verdicts certain", "safely stopped", "not armed", "neither"]


@dataclass(frozen=True)
class TrialResult:
    """The part of a trial that is kept, for the report of its campaign.

    `ended`: how the task ended; safely: with the arm at rest and no limit violated; or that the
    trial was ended before, since the verdict on each fault was certain. `misses`: their
    number by code; `stray_misses`: those that no fault explains. `unexplained`: false detections.
    `shortfalls`: a line each; none in a good trial. `start`: the tick of the snapshot from which
    it was run, or 0, and then `whole` says why.
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
    start: int = 0
    whole: str = ""


def result_of(trial: Trial) -> TrialResult:
    """Judge a trial."""
    outcome = trial.outcome
    verdict = _verdict(trial)
    ended = _ended(trial)
    ticks, digest = (outcome.ticks, outcome.digest) if outcome else (0, "")
    return TrialResult(
        plan=trial.plan,
        ended=ended,
        ticks=ticks,
        digest=digest,
        violations=trial.arm.violations,
        touches=trial.arm.touches,
        left=trial.left,
        wall_s=round(trial.wall_s, 3),
        notes=tuple(event.text for event in trial.events if event.kind == "ready"),
        misses=dict(Counter(event.code for event in trial.events if event.kind == "miss")),
        stray_misses=len(verdict.misses),
        faults=verdict.faults,
        unexplained=verdict.unexplained,
        shortfalls=_shortfalls(trial, verdict, ended),
        start=trial.start.tick,
        whole=trial.start.whole,
    )


def keep(trial: Trial, path: Path) -> None:
    """Judge a trial, and write it with all that happened in it to a file, which exists whole or not
    at all.
    """
    outcome = asdict(trial.outcome) if trial.outcome else None
    document = {
        "finding": asdict(result_of(trial)),
        "outcome": outcome,
        "refused": trial.refused,
        "levels": trial.levels,
        "events": [asdict(event) for event in trial.events],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, document)


_KEPT = TypeAdapter(TrialResult)


def kept(path: Path) -> TrialResult | None:
    """Return the result that a file keeps; None where there is no file."""
    try:
        return _KEPT.validate_python(json.loads(path.read_text())["finding"])
    except FileNotFoundError:
        return None


@dataclass(frozen=True)
class Faultless:
    """Runs without faults in real time, `seconds` of simulated time, under `load`: a command, or ""
    for alone.
    """

    load: str
    seconds: float
    runs: tuple[TrialResult, ...]

    @property
    def trips(self) -> int:
        """False trips: detections, and boards that died of no fault."""
        return sum(len(run.unexplained) for run in self.runs)

    @property
    def rate(self) -> EventRate | None:
        """The rate of false trips."""
        return rate(self.trips, self.seconds)

    @property
    def misses(self) -> dict[str, int]:
        """The number of misses by code: a busy machine explains them."""
        total: Counter[str] = Counter()
        for run in self.runs:
            total.update(run.misses)
        return dict(total)

    def document(self) -> Document:
        """Return the figures as plain data."""
        an_hour = asdict(self.rate) if self.rate else None
        return {
            "load": self.load,
            "seconds": round(self.seconds, 3),
            "trips": self.trips,
            "trips_per_hour": an_hour,
            "tripped": [asdict(event) for run in self.runs for event in run.unexplained],
            "misses": self.misses,
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
    def ended(self) -> Counter[Ended]:
        """The number of trials by how their task ended."""
        return Counter(run.ended for run in self.trials)

    @property
    def faults(self) -> list[Judgement]:
        """The judgements of all trials, without the sweep of sizes."""
        return [fault for run in self.trials for fault in run.faults]


def _verdict(trial: Trial) -> FaultVerdict:
    if trial.run is None:
        # The refusal is the detection of a fault that prevents a launch.
        tables = trial.plan.faults
        judged = tuple(_at_start(table["kind"], table["board"], trial) for table in tables)
        return FaultVerdict(judged, ())
    return judge(trial.strikes, trial.events, trial.run)


def _at_start(kind: str, board: str, trial: Trial) -> Judgement:
    if KINDS[kind].where != "start":
        return Judgement(kind, board, -1, "not struck")
    is_found = f"'{board}'" in trial.refused
    seen: Seen = "detected" if is_found else "missed"
    return Judgement(
        kind=kind,
        board=board,
        struck=0,
        seen=seen,
        found_by="the Rack",
        found_as="not armed",
        is_within=is_found,
        reactions=("not armed",),
        is_recovered=trial.again is not None and trial.again.worked,
    )


def _ended(trial: Trial) -> Ended:
    outcome = trial.outcome
    if trial.refused:
        is_to_be_refused = any(KINDS[table["kind"]].where == "start" for table in trial.plan.faults)
        return "not armed" if is_to_be_refused else "neither"
    if outcome is None or outcome.cause == "stopped":
        return "neither"
    if trial.is_cut:
        return "verdicts certain"
    if outcome.worked:
        return "task done"
    return "safely stopped" if trial.arm.is_at_rest and not trial.arm.violations else "neither"


def _shortfalls(trial: Trial, verdict: FaultVerdict, ended: Ended) -> tuple[str, ...]:
    lines = [line for fault in verdict.faults if fault.is_judged for line in _of_fault(fault)]
    lines += [
        f"{event.board}: {event.text}: no fault explains it (tick {event.tick})"
        for event in verdict.unexplained
    ]
    if trial.arm.violations:
        lines.append(f"limits violated at {trial.arm.violations} substeps")
    lines += [f"left behind: {thing}" for thing in trial.left]
    if ended == "neither":
        lines.append(f"the task is neither done nor safely stopped: {_why_not_done(trial)}")
    # A fault had to end the task if it is latched, or if reactions have taken the task's time.
    had_to_end = any(
        fault.is_latched or (trial.is_late and fault.reactions) for fault in verdict.faults
    )
    if ended == "safely stopped" and not lines and not had_to_end:
        lines.append(f"the task is not done, and no fault had to end it: {_why_not_done(trial)}")
    return tuple(lines)


def _why_not_done(trial: Trial) -> str:
    outcome = trial.outcome
    if trial.refused:
        return trial.refused
    if outcome is None:
        return f"it does not end; {trial.levels}"
    return "; ".join(filter(None, [outcome.cause, *outcome.faults, trial.levels]))


def _of_fault(fault: Judgement) -> Iterator[str]:
    target = f"{fault.mailbox or fault.board} {fault.joint}".rstrip()
    strike = f"{fault.kind} of {target}, struck at tick {fault.struck}"
    if fault.seen == "missed":
        yield f"{strike}: not detected"
    if fault.seen == "detected" and not fault.is_within:
        after = f"{fault.delay} ticks; bound {fault.bound}"
        if fault.bound_ms is not None:
            after = f"{fault.delay_ms:g} ms; bound {fault.bound_ms:g}"
        yield f"{strike}: {fault.found_as} by {fault.found_by} after {after}"
    yield from (f"{strike}: no {code.replace('_', ' ')} follows" for code in fault.lacking)
    if not fault.is_recovered:
        lost = ", ".join(fault.reactions) or "loss of messages"
        undone = "never undone"
        if fault.recovery is not None:
            undone = f"undone after {fault.recovery} ticks"
        yield f"{strike}: {lost} {undone}; bound {fault.recovery_bound}"
