"""Section 3 of the paper: soft time and real time, and equations 3.1 to 3.10."""

from __future__ import annotations

from dataclasses import replace

from rack.tools.lab.reproduction.experiments.deadline import DEADLINE, TOO_EARLY, GotoRun
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import settings_of
from rack.tools.lab.reproduction.experiments.nasrem import NASREM
from rack.tools.lab.reproduction.sections.equations import (
    PaperEquation,
    judged,
    measured_of,
    stolen,
    table_of,
)
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Chapter,
    Columns,
    Findings,
    Plate,
    Row,
    Ruling,
    Side,
    Statement,
    code,
    text,
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


def _sum_tested(equation: PaperEquation, findings: Findings) -> Assessment:
    """Judge eq. 3.3: the sum, and what waiting for the next read adds to it."""
    found = findings.of(NASREM)
    response = found.response
    verdicts = measured_of(equation.number, found)
    sum_ms = response.sum_eq_3_3_ms
    rows = [
        (
            name,
            f"{sum_ms:g}",
            f"{way.bound_ms:g}",
            f"{way.measured_ms.p50:g}",
            f"{way.measured_ms.max:g}",
            f"{response.bound_eq_3_2_ms:g}",
        )
        for name, way in (("command, down", response.command), ("status, up", response.status))
    ]
    head = (
        "",
        "sum of R<sub>i</sub>",
        "with waits for the grid",
        "measured, median",
        "longest",
        "n R<sub>max</sub>",
    )
    side: Side = [
        f"Along {' → '.join(response.levels)}, ms:",
        Columns(head, rows),
        table_of(verdicts),
    ]
    if not all(verdict.measured.holds for verdict in verdicts):
        late = len(response.command.beyond) + len(response.status.beyond)
        if late and found.missed + found.skipped:
            why = (
                f"{late} responses exceeded the sum with its waits, after missed cycles."
                f" {stolen(found)}"
            )
            return Assessment(side, Ruling.BOUNDED, why)
        return Assessment(
            side,
            Ruling.FAILS,
            f"{late} responses exceeded the sum with its waits, without a missed cycle.",
        )
    longest = max(response.command.measured_ms.max, response.status.measured_ms.max)
    if longest <= sum_ms:
        return Assessment(side, Ruling.HOLDS, "No response was longer than the sum.")
    why = (
        f"The sum alone is no bound: the longest response is {longest:g} ms, the sum {sum_ms:g}. A"
        " message also waits for its next read on the clock's grid: going down where a cycle does"
        " not divide the one above it, going up almost a cycle of every level. With these waits no"
        " response was longer than predicted, and the longest was as long."
    )
    return Assessment(side, Ruling.BOUNDED, why)


def _residual_tested(equation: PaperEquation, findings: Findings) -> Assessment:
    own = judged(equation, findings)
    found = findings.of(NASREM)
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
    plate = Plate(
        found.pictures["residuals"],
        "What the cycles of each level used of R<sub>i</sub>, and &alpha;.",
    )
    return replace(own, measured=[*own.measured, Columns(head, rows), plate])


SOFT = Chapter(
    "3",
    (Statement("soft-and-real-time", (DEADLINE,), _goto, _goto_tested),),
)
RESPONSE = Chapter(
    "3.1",
    (FITS.statement(), BOUND.statement(), SUM.statement(_sum_tested)),
)
LOW = Chapter(
    "3.2",
    (EXECUTES.statement(), PARTS.statement(), RESIDUAL.statement(_residual_tested)),
)
HIGH = Chapter(
    "3.3",
    (GRID.statement(), TIGHT.statement(), WITH_PLANNER.statement(), SMALL.statement()),
)
