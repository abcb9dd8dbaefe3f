"""GOTO A, and GOTO A BY t: the same motion in soft time, by a time that is too early, and by one
that can be met."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

from rack.boards.config import RackConfig, load
from rack.tools.console.answer import Failure
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    Workshop,
    need_real_time,
)
from rack.tools.recording.recording import Recording

NAME = "nasrem"
ABOVE_M = 0.12
"""A is so far above the place to which the rack's own program takes its first object."""
TOO_EARLY = 0.5
"""Part of the time in soft time that is demanded first."""
LASTS_S = 32.0


@dataclass(frozen=True)
class GotoRun:
    """A run of GOTO A, GOTO B, s: by when A was demanded, when it was reported done, and the
    earliest time that a refusal named."""

    by_s: float | None
    done_s: float | None
    earliest_s: float | None
    moved: bool
    cause: str
    reason: str


@dataclass(frozen=True)
class GotoRuns:
    """A, m, in soft time, by a time that is too early, and by one that can be met."""

    place: tuple[float, ...]
    soft: GotoRun
    early: GotoRun
    met: GotoRun


def _run(workshop: Workshop) -> GotoRuns:
    need_real_time()
    place = _place(load(NAME))
    soft = _outcome(workshop, "goto", place, None)
    if soft.done_s is None:
        raise Failure(f"goto without a time was not done: {soft.cause}")
    early = _outcome(workshop, "goto-too-early", place, round(TOO_EARLY * soft.done_s, 2))
    # Without a refusal there is no other time to demand than that of the first run.
    met = _outcome(workshop, "goto-by", place, ceil((early.earliest_s or soft.done_s) * 10) / 10)
    return GotoRuns(tuple(place), soft, early, met)


DEADLINE = Experiment(
    "goto",
    "goto in soft time, and by a time",
    LASTS_S,
    GotoRuns,
    _run,
)


def _place(config: RackConfig) -> list[float]:
    """Return A: above the goal of the first object that the program moves."""
    x, y, z = next(action["to"] for action in config.task["action"] if "to" in action)
    return [x, y, round(z + ABOVE_M, 6)]


def _outcome(workshop: Workshop, label: str, place: list[float], by_s: float | None) -> GotoRun:
    """Run GOTO A, then GOTO B, the start; return when A was reported done, or the refusal."""
    by = "" if by_s is None else f", by = {by_s!r}"
    program = f'task.action=[{{ do = "goto", position = {place}{by} }}, {{ do = "home" }}]'
    config = workshop.config(NAME, [program])
    result, recording = workshop.run(label, config)
    outcome = result.outcome
    return GotoRun(
        by_s=by_s,
        done_s=_done_s(recording),
        earliest_s=_earliest_s(recording),
        moved=_has_moved(recording),
        cause=outcome.cause,
        reason=outcome.reason or recording.reason("task.status", -1),
    )


def _done_s(recording: Recording) -> float | None:
    """Return the end of the cycle in which the task level reported A done, s; None: it never
    did."""
    done, ticks = (recording.signal("task.status", name) for name in ("action", "visible_at"))
    reported = ticks[done >= 1]
    return float(reported[0]) * recording.layout.clock_ns * 1e-9 if len(reported) else None


def _earliest_s(recording: Recording) -> float | None:
    """Return the time that the planner offered instead, s; None: it did not refuse."""
    if "task.plan" not in recording.mailboxes:
        return None
    earliest = recording.signal("task.plan", "earliest")
    return next((float(time_s) for time_s in earliest if time_s > 0), None)


def _has_moved(recording: Recording) -> bool:
    moves = recording.signal("task.status", "moves_done")
    return bool(len(moves)) and int(moves[-1]) > 0
