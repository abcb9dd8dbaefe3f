"""Results of a campaign: evaluated trials, each saved in a file, and faultless time."""

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
from rack.tools.faults.campaigns.outages import Outage, list_outages
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.statistics import EventRate, compute_rate
from rack.tools.faults.campaigns.trial import Trial
from rack.tools.faults.judge import FaultVerdict, Judge, Judgement, Seen

Ended = Literal["task done", "verdicts certain", "safely stopped", "not armed", "neither"]


@dataclass(frozen=True)
class TrialResult:
    """Result of a trial, which is saved for the report of its campaign.

    Attributes:
        plan: Plan of the trial.
        ended: How the trial ended: with the task done, early because all verdicts were certain,
            safely stopped (arm at rest, no limit violated), not armed, or otherwise.
        ticks: Length of the run in ticks.
        digest: Digest of the run.
        violations: Number of violated limits.
        touches: Number of unintended contacts.
        left: Everything that the rack left behind.
        wall_s: Duration in s of real time.
        notes: Notes of the launch.
        misses: Number of deadline misses, by code.
        stray_misses: Number of misses that no fault explains.
        faults: Judgements of its faults.
        unexplained: Detections that no fault explains.
        shortfalls: What was wrong, a line each. Empty for a successful trial.
        start: Tick of the snapshot from which the trial continued. 0 if it did not.
        whole: Why the trial did not continue from a snapshot. Empty if it did.
        outages: Ticks without output after each fault that ended the process of an executor.
        missing: Number of messages that the boards of its faults have not written.
        begins: Tick at which each fault of the plan began, or was due when the trial ended. Empty
            if the trial kept to the ticks of its plan.
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
    outages: tuple[Outage, ...] = ()
    missing: int = 0
    begins: tuple[int, ...] = ()

    @property
    def actual_plan(self) -> Plan:
        """The plan with the ticks at which its faults began."""
        return self.plan.move_faults(self.begins) if self.begins else self.plan


def judge_trial(trial: Trial) -> TrialResult:
    """Evaluate a trial and return the result that its campaign saves."""
    outcome = trial.outcome
    verdict = _judge_faults(trial)
    ended = _classify_end(trial)
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
        shortfalls=_list_shortfalls(trial, verdict, ended),
        start=trial.start.tick,
        whole=trial.start.whole,
        outages=tuple(list_outages(trial.strikes, trial.events, trial.run.layout))
        if trial.run is not None
        else (),
        missing=trial.missing,
        begins=trial.begin_ticks,
    )


def save_result(trial: Trial, path: Path) -> None:
    """Evaluate a trial and atomically write the result and all events to a file."""
    outcome = asdict(trial.outcome) if trial.outcome else None
    document = {
        "finding": _RESULT.dump_python(judge_trial(trial)),
        "outcome": outcome,
        "refused": trial.refused,
        "levels": trial.levels,
        "events": _EVENTS.dump_python(trial.events),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, document)


_RESULT = TypeAdapter(TrialResult)
_EVENTS = TypeAdapter(tuple[Event, ...])


def load_result(path: Path) -> TrialResult | None:
    """Load the result from a file. Return None if the file does not exist."""
    try:
        return _RESULT.validate_python(json.loads(path.read_text())["finding"])
    except FileNotFoundError:
        return None


@dataclass(frozen=True)
class FaultlessTime:
    """Runs without faults in real time.

    Attributes:
        load: Description of the load on the machine. Empty without load.
        seconds: Simulated time of the runs in s.
        runs: Results of the runs.
    """

    load: str
    seconds: float
    runs: tuple[TrialResult, ...]

    @property
    def trips(self) -> int:
        """Number of false trips, which are detections and deaths of boards without a fault."""
        return sum(len(run.unexplained) for run in self.runs)

    @property
    def rate(self) -> EventRate | None:
        """Rate of false trips. None if there were no runs."""
        return compute_rate(self.trips, self.seconds)

    @property
    def misses(self) -> dict[str, int]:
        """Dictionary from event codes to numbers of deadline misses, which are not false trips."""
        total: Counter[str] = Counter()
        for run in self.runs:
            total.update(run.misses)
        return dict(total)

    def to_document(self) -> Document:
        """Return the figures as plain data."""
        rate_document = asdict(self.rate) if self.rate else None
        return {
            "load": self.load,
            "seconds": round(self.seconds, 3),
            "trips": self.trips,
            "trips_per_hour": rate_document,
            "tripped": [asdict(event) for run in self.runs for event in run.unexplained],
            "misses": self.misses,
        }


@dataclass
class Results:
    """Results of all runs of a campaign.

    Attributes:
        nominal: Faultless run in lockstep.
        trials: Trials with faults and kills.
        sizes: Trials for curves of size against delay.
        faultless: Faultless time.
        lacking: A line for each kind of fault that acted too rarely despite repeated draws.
        is_interrupted: Whether the campaign was interrupted.
    """

    nominal: TrialResult
    trials: list[TrialResult] = field(default_factory=list)
    sizes: list[TrialResult] = field(default_factory=list)
    faultless: list[FaultlessTime] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    is_interrupted: bool = False

    @property
    def runs(self) -> list[TrialResult]:
        """Results of all runs, whatever their purpose."""
        faultless = [run for stretch in self.faultless for run in stretch.runs]
        return [self.nominal, *self.trials, *self.sizes, *faultless]

    @property
    def ended(self) -> Counter[Ended]:
        """Number of trials for each kind of ending."""
        return Counter(run.ended for run in self.trials)

    @property
    def faults(self) -> list[Judgement]:
        """Judgements of the faults of all trials, except the trials for curves of size."""
        return [fault for run in self.trials for fault in run.faults]


def _judge_faults(trial: Trial) -> FaultVerdict:
    """Evaluate the faults of a trial."""
    if trial.run is None:
        # A fault that prevents a launch is detected by the refusal of the launch.
        tables = trial.plan.faults
        judged = tuple(_judge_start_fault(table["kind"], table["board"], trial) for table in tables)
        return FaultVerdict(judged, ())
    return Judge(trial.strikes, trial.events, trial.run).judge_all()


def _judge_start_fault(kind: str, board: str, trial: Trial) -> Judgement:
    """Evaluate a fault of a rack whose launch was refused.

    A fault of the self-test counts as detected if the refusal names its board. Other faults did not
    act.
    """
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
        is_recovered=trial.again is not None and trial.again.is_success,
    )


def _classify_end(trial: Trial) -> Ended:
    """Return how a trial ended: see `TrialResult.ended`."""
    outcome = trial.outcome
    if trial.refused:
        is_to_be_refused = any(KINDS[table["kind"]].where == "start" for table in trial.plan.faults)
        return "not armed" if is_to_be_refused else "neither"
    if outcome is None or outcome.cause == "stopped":
        return "neither"
    if trial.is_cut:
        return "verdicts certain"
    if outcome.is_success:
        return "task done"
    return "safely stopped" if trial.arm.is_at_rest and not trial.arm.violations else "neither"


def _list_shortfalls(trial: Trial, verdict: FaultVerdict, ended: Ended) -> tuple[str, ...]:
    """Return a line for each shortfall of a trial. Empty for a successful trial."""
    lines = [
        line
        for fault in verdict.faults
        if fault.is_judged
        for line in _list_fault_shortfalls(fault)
    ]
    lines += [
        f"no fault explains this event of {event.board} at tick {event.tick}: {event.text}"
        for event in verdict.unexplained
    ]
    if trial.arm.violations:
        lines.append(f"limits violated at {trial.arm.violations} substeps")
    lines += [f"left behind: {leftover}" for leftover in trial.left]
    if ended == "neither":
        lines.append(f"the task is neither done nor safely stopped: {_explain_not_done(trial)}")
    # A fault had to end the task if it latched, or if the reactions to it made the task too late.
    had_to_end = any(
        fault.is_latched or (trial.is_late and fault.reactions) for fault in verdict.faults
    )
    if ended == "safely stopped" and not lines and not had_to_end:
        lines.append(
            f"the task is not done, and no fault had to end it: {_explain_not_done(trial)}"
        )
    return tuple(lines)


def _explain_not_done(trial: Trial) -> str:
    """Return why the task of a trial was not done."""
    outcome = trial.outcome
    if trial.refused:
        return trial.refused
    if outcome is None:
        return f"it does not end; {trial.levels}"
    return "; ".join(filter(None, [outcome.cause, *outcome.faults, trial.levels]))


def _list_fault_shortfalls(fault: Judgement) -> Iterator[str]:
    """Yield a line for each shortfall in the detection of a fault, its reactions and recovery."""
    target = f"{fault.mailbox or fault.board} {fault.joint}".rstrip()
    strike = f"{fault.kind} of {target} at tick {fault.struck}"
    if fault.seen == "missed":
        yield f"{strike} was not detected"
    if fault.seen == "detected" and not fault.is_within:
        delay_text = f"{fault.delay} ticks; its bound is {fault.bound}"
        if fault.bound_ms is not None:
            delay_text = f"{fault.delay_ms:g} ms; its bound is {fault.bound_ms:g} ms"
        yield f"{strike} was reported as {fault.found_as} by {fault.found_by} after {delay_text}"
    yield from (
        f"{strike} was not followed by '{code.replace('_', ' ')}'" for code in fault.lacking
    )
    if not fault.is_recovered:
        reaction_text = ", ".join(fault.reactions) or "loss of messages"
        undone = "never undone"
        if fault.recovery is not None:
            undone = f"undone only after {fault.recovery} ticks"
        # A refused launch has no bound for its recovery.
        has_bound = fault.recovery_bound is not None
        bound_text = f" (bound in ticks: {fault.recovery_bound})" if has_bound else ""
        yield f"{strike}: {reaction_text} was {undone}{bound_text}"
