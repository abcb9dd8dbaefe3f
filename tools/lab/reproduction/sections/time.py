"""Section 3 of the paper before its equations: soft time, and real time."""

from __future__ import annotations

from rack.tools.lab.reproduction.experiments.deadline import DEADLINE, TOO_EARLY, GotoRun
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Columns,
    Row,
    Ruling,
    Side,
    code,
    text,
)
from rack.tools.lab.reproduction.sections.statement import Chapter, Findings, Statement


def _goto(workshop: Workshop) -> Side:
    return [
        f"A is a pose above the first object's goal, B the start. In a task, {code('by')} is the"
        " simulated time by which an action must be done. The task's planner rehearses the whole"
        " program before anything moves and adds up the longest times of planning, waiting for the"
        " grid, motion and settling. It refuses a time that it cannot promise, and names the"
        f" earliest that it can. We first run without times, then with {100 * TOO_EARLY:g} % of the"
        " time that took, then with the time that the refusal names, rounded up to a tenth of a"
        " second."
    ]


def _goto_tested(findings: Findings) -> Assessment:
    found = findings.of(DEADLINE)
    early = found.early
    met = found.met
    rows = [_row(run) for run in (found.soft, early, met)]
    head = ("program", "A reported done, s", "did the arm move", "end of the run", "reason")
    side: Side = [Columns(head, rows, f"At A: {list(found.place)} m. Runs in lockstep.")]
    is_refused = early.done_s is None and not early.moved
    is_met = met.done_s is not None and met.by_s is not None and met.done_s <= met.by_s
    if is_refused and is_met:
        why = (
            f"By {early.by_s:g} s is refused before anything moves; by {met.by_s:g} s is"
            f" promised, and done at {met.done_s:g} s. Without a time nothing is promised."
        )
        return Assessment(side, Ruling.HOLDS, why)
    return Assessment(
        side, Ruling.FAILS, f"Refused when it must be: {is_refused}; met when promised: {is_met}."
    )


def _row(run: GotoRun) -> Row:
    by = "" if run.by_s is None else f" BY {run.by_s} s"
    done = "never" if run.done_s is None else f"{run.done_s:g}"
    moved = "yes" if run.moved else "no"
    return f"GOTO A{by}, GOTO B", done, moved, text(run.cause), text(run.reason) or "-"


CHAPTER = Chapter(
    "3",
    (Statement("soft-and-real-time", (DEADLINE,), _goto, _goto_tested),),
)
