"""GOTO A, and GOTO A BY t: the same motion in soft time, by a time that is too early, and by one
that can be met."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from rack.boards.config import load
from rack.tools.console.answer import Failure
from rack.tools.lab.reproduction.experiments.experiment import Experiment, Workshop

NAME = "nasrem"
ABOVE_M = 0.12
"""A is so far above the place to which the rack's own program takes its first object."""
TOO_EARLY = 0.5
"""Part of the time in soft time that is demanded first."""
LASTS_S = 32.0


@dataclass(frozen=True)
class GotoRun:
    """A run of GOTO A, GOTO B, s.

    Attributes:
        by_s: Time by which A was demanded; None for soft time.
        done_s: End of the cycle in which the task level reported A done; None if it never did.
        earliest_s: Time that a refusal named instead; None without a refusal.
        moved: Whether the arm did a move.
    """

    by_s: float | None
    done_s: float | None
    earliest_s: float | None
    moved: bool


@dataclass(frozen=True)
class GotoRuns:
    """A by a time that is too early, and by one that can be met."""

    early: GotoRun
    met: GotoRun


def _measure(workshop: Workshop) -> GotoRuns:
    soft = _goto(workshop, "goto", None)
    if soft.done_s is None:
        raise Failure("goto without a time was not done")
    early = _goto(workshop, "goto-too-early", round(TOO_EARLY * soft.done_s, 2))
    # Without a refusal, the time of the first run is demanded.
    by_s = ceil((early.earliest_s or soft.done_s) * 10) / 10
    return GotoRuns(early, _goto(workshop, "goto-by", by_s))


DEADLINE = Experiment("goto", "goto in soft time, and by a time", LASTS_S, GotoRuns, _measure)


def _goto(workshop: Workshop, label: str, by_s: float | None) -> GotoRun:
    """Run GOTO A, above the goal of the first object that the program moves, then GOTO B, the
    start."""
    x, y, z = next(action["to"] for action in load(NAME).task["action"] if "to" in action)
    by = "" if by_s is None else f", by = {by_s!r}"
    place = [x, y, round(z + ABOVE_M, 6)]
    program = f'task.action=[{{ do = "goto", position = {place}{by} }}, {{ do = "home" }}]'
    recording = workshop.run(label, workshop.config(NAME, [program])).recording
    done, ticks, moves = (
        recording.signal("task.status", name) for name in ("action", "visible_at", "moves_done")
    )
    times_s = ticks[done >= 1] * recording.layout.clock_ns * 1e-9
    earliest_s = np.zeros(0)
    if "task.plan" in recording.mailboxes:
        earliest_s = recording.signal("task.plan", "earliest")
    return GotoRun(
        by_s=by_s,
        done_s=next(iter(times_s.tolist()), None),
        earliest_s=next(iter(earliest_s[earliest_s > 0].tolist()), None),
        moved=bool(moves.any()),
    )
