"""Section 3 of the paper: soft time and real time, and equations 3.1 to 3.10."""

from __future__ import annotations

from math import inf

from rack.tools.lab.reproduction.experiments.deadline import (
    DEADLINE,
    TOO_EARLY,
    GotoRun,
    GotoRuns,
)
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import settings_of
from rack.tools.lab.reproduction.experiments.nasrem import (
    NasremRun,
    Percentiles,
    SystemResponse,
)
from rack.tools.lab.reproduction.sections.equations import (
    PaperEquation,
)
from rack.tools.lab.reproduction.sections.page import (
    Chapter,
    ClaimVerdict,
    Columns,
    Requirement,
    Row,
    Side,
    Statement,
    code,
    ruled,
    text,
)
from rack.tools.lab.reproduction.sections.sharing import (
    BACKGROUND,
    EXCHANGE,
    LOOSE,
    UPDATE,
    WAITING,
)

HURRIED = ("timing.response_ms=1000",)
"""A response within 1 s is demanded of the same four levels."""
FITS = PaperEquation("3.1", "fig4-overload")
BOUND = PaperEquation("3.2", "nasrem", HURRIED)
SUM = PaperEquation("3.3", "nasrem", HURRIED)
EXECUTES = PaperEquation("3.4", "fig4-overload", settings_of("fig4-overload", 6.0))
PARTS = PaperEquation("3.5", "fig4-overload")
RESIDUAL = PaperEquation("3.6", "fig4", settings_of("fig4", 3.0))
GRID = PaperEquation("3.7", "nasrem", ("board.primitive.rate_hz=60",))
TIGHT = PaperEquation("3.8", "fig3")
WITH_PLANNER = PaperEquation("3.9", "fig3", settings_of("fig3", 3.0))
SMALL = PaperEquation("3.10", "fig2", ("timing.small_share=0.1",))


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


def _goto_measured(workshop: Workshop, found: GotoRuns) -> Side:
    rows = [_row(run) for run in (found.soft, found.early, found.met)]
    head = ("program", "A reported done, s", "did the arm move", "end of the run", "reason")
    return [Columns(head, rows, f"At A: {list(found.place)} m. Runs in real time.")]


def judge_goto(found: GotoRuns) -> ClaimVerdict:
    """Compare when A was done with the time by which it was promised."""
    early = found.early
    met = found.met
    done_s = inf if met.done_s is None else met.done_s
    begun = early.moved + (early.done_s is not None)
    return ruled(
        (
            Requirement(f"by {early.by_s:g} s, too early: motions begun", begun, "=", 0),
            Requirement("by the time promised: A done", done_s, "<=", met.by_s or 0.0, "s"),
        ),
        "A time that is too early is refused before anything moves; one that is promised is met."
        " Without a time nothing is promised.",
    )


def _row(run: GotoRun) -> Row:
    by = "" if run.by_s is None else f" BY {run.by_s} s"
    done = "never" if run.done_s is None else f"{run.done_s:g}"
    moved = "yes" if run.moved else "no"
    return f"GOTO A{by}, GOTO B", done, moved, text(run.cause), text(run.reason) or "-"


def _ways(response: SystemResponse) -> list[tuple[str, float, Percentiles]]:
    """Return the ways that something went: the name, the bound of the grid and the times, ms."""
    both = {"command, down": response.command, "status, up": response.status}
    return [
        (name, way.bound_ms, way.measured_ms)
        for name, way in both.items()
        if way.measured_ms is not None
    ]


def _sum_measured(found: NasremRun) -> Side:
    """Return the sum, and what waiting for the next read adds to it."""
    response = found.response
    rows = [
        (
            name,
            f"{response.sum_eq_3_3_ms:g}",
            f"{bound_ms:g}",
            f"{times.p50:g}",
            f"{times.max:g}",
            f"{response.bound_eq_3_2_ms:g}",
        )
        for name, bound_ms, times in _ways(response)
    ]
    head = (
        "",
        "sum of R<sub>i</sub>",
        "with waits for the grid",
        "measured, median",
        "longest",
        "n R<sub>max</sub>",
    )
    words = (
        "A message also waits for its next read on the clock's grid: going down where a cycle does"
        " not divide the one above it, going up almost a cycle of every level."
    )
    return [f"{words} Along {' → '.join(response.levels)}, ms:", Columns(head, rows)]


def judge_sum(equation: PaperEquation, found: NasremRun) -> ClaimVerdict:
    """Compare the longest responses with the sum alone; within bounds, with the sum and its
    waits, which a missed cycle may prolong."""
    response = found.response
    beyond = [*response.command.beyond, *response.status.beyond]
    unexplained = sum(not any("missed" in delay for delay in one["delayed_by"]) for one in beyond)
    total_ms = response.sum_eq_3_3_ms
    ways = _ways(response)
    return ruled(
        [
            Requirement(f"{name}: the sum", times.max, "<=", total_ms, "ms")
            for name, _, times in ways
        ],
        "No response was longer than the sum.",
        here=(Requirement("beyond the sum with its waits, without a miss", unexplained, "=", 0),),
        needs=(Requirement("ways that something went, down and up", len(ways), "=", 2),),
    )


def _residuals(found: NasremRun) -> Side:
    rows = [
        (
            name,
            f"{task.slice_ms:g}",
            f"{task.used_ms.p50:.3f}",
            f"{task.used_ms.max:.3f}",
            f"{task.deviation_ms:.3f}",
        )
        for name, task in found.executors.items()
    ]
    head = (
        "level",
        "R<sub>i</sub>",
        "used, median",
        "used, longest",
        "standard deviation of the residual",
    )
    return [Columns(head, rows)]


SOFT = Chapter(
    "3",
    (Statement("soft-and-real-time", (DEADLINE,), judge_goto, _goto, _goto_measured),),
)
RESPONSE = Chapter(
    "3.1",
    (FITS.statement(), BOUND.statement(), SUM.statement(judge_sum, _sum_measured)),
)
LOW = Chapter(
    "3.2",
    (EXECUTES.statement(), PARTS.statement(), RESIDUAL.statement(further=_residuals)),
)
HIGH = Chapter(
    "3.3",
    (
        BACKGROUND,
        LOOSE,
        GRID.statement(),
        WAITING,
        TIGHT.statement(),
        WITH_PLANNER.statement(),
        UPDATE,
        SMALL.statement(),
        EXCHANGE,
    ),
)
