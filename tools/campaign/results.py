"""What a campaign has found so far: trials with their verdicts, faultless time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from tools.campaign.judge import Judgement, Verdict, judge
from tools.campaign.trial import Trial

Ended = Literal["task done", "safely stopped", "not armed", "neither"]
MISS = "miss"


@dataclass(frozen=True)
class Judged:
    """A trial and its verdict."""

    trial: Trial
    verdict: Verdict

    @classmethod
    def of(cls, trial: Trial) -> Judged:
        """Judge a trial."""
        if trial.refused or trial.layout is None:
            return cls(trial, Verdict(_refused(trial), ()))
        return cls(trial, judge(trial.strikes, trial.events, trial.layout, trial.offset_ns, trial.plan.lockstep))

    @property
    def ended(self) -> Ended:
        """How the task ended; safely: with the arm standing, and no limit violated."""
        trial, outcome = self.trial, self.trial.outcome
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
        return any(table["kind"] == "self-test" for table in self.trial.plan.faults)

    @property
    def shortfalls(self) -> list[str]:
        """What is not as it must be, a line each; empty for a good trial."""
        trial = self.trial
        lines = [_shortfall(fault) for fault in self.verdict.faults if fault.is_judged and _falls_short(fault)]
        lines += [f"{e.board}: {e.text}: no fault explains it (tick {e.tick})" for e in self.verdict.unexplained]
        lines += [f"limits violated at {trial.arm.violations} substeps"] if trial.arm.violations else []
        lines += [f"left behind: {thing}" for thing in trial.left]
        if self.ended == "neither":
            lines.append(f"the task is neither done nor safely stopped: {self._why_neither()}")
        return lines

    def _why_neither(self) -> str:
        trial, outcome = self.trial, self.trial.outcome
        if trial.refused or outcome is None:
            return trial.refused or f"it does not end; {trial.levels}"
        return "; ".join(filter(None, [outcome.cause, *outcome.faults, trial.levels]))

    def document(self) -> dict[str, Any]:
        """Return the trial as plain data: a line of trials.jsonl."""
        trial, outcome = self.trial, self.trial.outcome
        return {
            **trial.plan.document(),
            "ended": self.ended,
            "outcome": asdict(outcome) if outcome else None,
            "refused": trial.refused,
            "levels": trial.levels,
            "violations": trial.arm.violations,
            "touches": trial.arm.touches,
            "left": list(trial.left),
            "wall_s": round(trial.wall_s, 3),
            "misses": misses_of([trial]),
            "judgements": [asdict(fault) for fault in self.verdict.faults],
            "unexplained": [asdict(event) for event in self.verdict.unexplained],
            "shortfalls": self.shortfalls,
            "events": [asdict(event) for event in trial.events],
        }


@dataclass(frozen=True)
class Faultless:
    """Running without faults in real time, `seconds` of it, beside `load` busy processes."""

    load: int
    seconds: float
    trials: tuple[Judged, ...]

    @property
    def trips(self) -> int:
        """False trips: detections, and boards that died of no fault."""
        return sum(len(judged.verdict.unexplained) for judged in self.trials)

    def document(self) -> dict[str, Any]:
        """Return the figures as plain data."""
        return {
            "load": self.load,
            "seconds": round(self.seconds, 3),
            "trips": self.trips,
            "trips_per_hour": round(self.trips * 3600.0 / self.seconds, 3) if self.seconds else None,
            "tripped": [asdict(event) for judged in self.trials for event in judged.verdict.unexplained],
            "misses": misses_of([judged.trial for judged in self.trials]),
        }


@dataclass
class Results:
    """Everything that a campaign has done. `nominal` is its faultless run in lockstep."""

    nominal: Judged
    trials: list[Judged] = field(default_factory=list)
    sizes: list[Judged] = field(default_factory=list)
    faultless: list[Faultless] = field(default_factory=list)
    is_interrupted: bool = False

    @property
    def runs(self) -> list[Judged]:
        """All runs, of whatever purpose."""
        calm = [judged for part in self.faultless for judged in part.trials]
        return [self.nominal, *self.trials, *self.sizes, *calm]

    @property
    def faults(self) -> list[Judgement]:
        """The judgements of all trials; those of the sweep of sizes are not among them."""
        return [fault for judged in self.trials for fault in judged.verdict.faults]


def misses_of(trials: Sequence[Trial]) -> dict[str, int]:
    """Return how many misses of each code there were: a busy machine explains them."""
    return dict(Counter(event.code for trial in trials for event in trial.events if event.kind == MISS))


def _refused(trial: Trial) -> tuple[Judgement, ...]:
    """Return the judgement of faults that keep a rack from launching: the refusal is their detection."""
    return tuple(
        Judgement(
            kind=table["kind"],
            board=table["board"],
            mailbox="",
            joint="",
            size=None,
            began=-1,
            struck=0 if table["kind"] == "self-test" else -1,
            seen=_seen_at_start(table, trial),
            is_judged=True,
            cycle=1,
            found_by="the Rack",
            found_as="not armed",
            is_within=_seen_at_start(table, trial) == "detected",
            reactions=("not armed",),
        )
        for table in trial.plan.faults
    )


def _seen_at_start(table: Any, trial: Trial) -> Literal["detected", "missed", "not struck"]:
    if table["kind"] != "self-test":
        return "not struck"
    return "detected" if f"'{table['board']}'" in trial.refused else "missed"


def _falls_short(fault: Judgement) -> bool:
    return fault.seen == "missed" or (fault.seen == "detected" and not fault.is_within)


def _shortfall(fault: Judgement) -> str:
    what = f"{fault.kind} of {fault.mailbox or fault.board}{' ' + fault.joint if fault.joint else ''}"
    at = f"struck at tick {fault.struck}"
    if fault.seen == "missed":
        return f"{what}, {at}: not detected"
    if fault.bound_ms is not None:
        return f"{what}, {at}: {fault.found_as} after {fault.delay_ms:g} ms; bound {fault.bound_ms:g}"
    return f"{what}, {at}: {fault.found_as} by {fault.found_by} after {fault.delay} ticks; bound {fault.bound}"
