"""Sections 3.1 to 3.3 of the paper: equations 3.1 to 3.10."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rack.tools.lab.reproduction.experiments.figures import settings_of
from rack.tools.lab.reproduction.experiments.nasrem import NASREM
from rack.tools.lab.reproduction.sections.equations import (
    Biting,
    PaperEquation,
    judged,
    measured_of,
    stolen,
    table_of,
)
from rack.tools.lab.reproduction.sections.page import Assessment, Columns, Plate, Ruling, Side
from rack.tools.lab.reproduction.sections.statement import Chapter, Findings

R_I = "R<sub>i</sub>"
R_MAX = "R<sub>max</sub>"
R_S = "R<sub>s</sub>"
EXEC, COMM, REST = (f"t<sup>i</sup><sub>{name}</sub>" for name in ("exec", "comm", "residual"))
SWITCH = "t<sub>cs</sub>"
HURRIED = Biting(
    "nasrem",
    ("timing.response_ms=1000",),
    "a response within 1 s is demanded of the same four levels",
)

FITS = PaperEquation(
    "3.1",
    "processing and communication fit the cycle",
    "If the ith level spends t<sub>c</sub> seconds communicating/waiting for commands and status,"
    " and t<sub>proc</sub> processing, this leads to the following minimum timing constraint for"
    " each cycle.",
    f"( t<sup>i</sup><sub>proc</sub> + t<sup>i</sup><sub>c</sub> ) = {R_I} ≤ {R_MAX}, for each i ="
    " 1 … n",
    "A level waits for its next cycle when it has finished, so that the sum without that wait must"
    " fit the cycle.",
    Biting("fig4-overload", (), "figure 4 with its newer executor"),
)
BOUND = PaperEquation(
    "3.2",
    "the bound on the system's response",
    "An upper bound to the system response time R<sub>s</sub> can be calculated as follows. ... No"
    " level can exceed this time limit and still guarantee proper system communication flow.",
    f"{R_S} ≤ n {R_MAX}",
    "The response is counted from the release of the highest level to the end of the lowest level's"
    " cycle that rests on its command, or back with a status; it includes every wait for a level's"
    " next read.",
    HURRIED,
)
SUM = PaperEquation(
    "3.3",
    "the system's response as a sum",
    "This leads to a definition of R<sub>s</sub>, system response time, as the sum of R<sub>i</sub>"
    " response times tied to the machine update rate, and the sum of R<sub>j</sub> response times"
    " arbitrarily set to meet the system response time goal.",
    f"{R_S} = Σ {R_I} + Σ R<sub>j</sub>, for i = 1 … m and j = m+1 … n, where all R<sub>k</sub> ≤"
    f" {R_MAX}",
    "The sum of the cycles is compared with the bound of equation 3.2.",
    HURRIED,
)
EXECUTES = PaperEquation(
    "3.4",
    "the executor's time is below the limit",
    "An initial assumption is that t<sub>exec</sub>, the time the executor runs each cycle, is less"
    " than the level response time limit maximum; otherwise the system response time must be"
    " increased or a finer resolution of task decomposition must be attempted.",
    f"{EXEC} &lt; {R_MAX}",
    "Without a goal for the response, R<sub>max</sub> is the longest cycle of the hierarchy: a weak"
    " demand on the fast levels, for which equation 3.1 is the sharper one.",
    Biting(
        "fig4-overload",
        settings_of("fig4-overload", 6.0),
        "its executor takes 6 ms of 6 ms",
    ),
)
PARTS = PaperEquation(
    "3.5",
    "the parts of a cycle",
    "R<sub>i</sub> is composed of t<sub>exec</sub>, the time each level spends running the"
    " executor, t<sub>comm</sub>, the time spent communicating/waiting for data, and"
    " t<sub>residual</sub>, time remaining before the next cycle.",
    f"{R_I} = {EXEC} + {COMM} + {REST}",
    "A definition: the residual is what is left. It fails only where the first two exceed the"
    " cycle, as time is not negative.",
    Biting("fig4-overload", (), "figure 4 with its newer executor needs more than its cycle"),
)
RESIDUAL = PaperEquation(
    "3.6",
    "the residual of the worst cycle",
    "Smooth motion results from an efficient input-compute-output cycle that maintains a small"
    " standard deviation each cycle with an upper bound &alpha; on variance. ... [The residual]"
    " must be bounded by a sum of the worst case times for both processing and communication.",
    f"0 &lt; {REST} ≤ &alpha; = {R_I} &minus; max<sub>j</sub> t<sup>i,j</sup><sub>exec</sub>"
    " &minus; max<sub>j</sub> t<sup>i,j</sup><sub>comm</sub>",
    "The right side is &alpha;. As printed, a residual is at most &alpha;; of a single cycle the"
    " opposite is true: &alpha; takes the worst times, so that every cycle has at least &alpha;"
    " left. We read &alpha; as what a planner can count on.",
    Biting(
        "fig4",
        settings_of("fig4", 3.0),
        "figure 4 with the longest X that the paper permits",
    ),
)
GRID = PaperEquation(
    "3.7",
    "cycles of fixed length",
    "Levels execute every cycle and these cycles are of fixed time c. This leads to the following"
    " equality of time cycles throughout the system.",
    "t<sub>i+1</sub> = t<sub>i</sub> + c, for i = 0 … ∞ cycles",
    "One system clock gives all cycles, so that every one is a whole number of its periods.",
    Biting(
        "nasrem",
        ("board.primitive.rate_hz=60",),
        "a rate that does not divide the clock's is refused",
    ),
)
TIGHT = PaperEquation(
    "3.8",
    "a planner on its executor's processor",
    "The requirement that the planner must finish any plan within d cycles should be imposed on a"
    " level. ... If this condition cannot be held, then a multiprocessor planner and executor level"
    " should be used.",
    f"t<sup>i</sup><sub>plan</sub> / d<sup>i</sup> &lt; {REST} &minus; 2 {SWITCH}",
    "t<sub>plan</sub> includes the update of the plan; d is <code>within_cycles</code> of the"
    " board. It concerns the levels whose planners are tightly coupled.",
    Biting("fig3", (), "figure 3"),
)
WITH_PLANNER = PaperEquation(
    "3.9",
    "the cycle with a planner in it",
    "Including the planner on the same processor adds two extra context switches to a cycle, ..."
    " plus increases the amount of communication time to include both interlevel communication and"
    " communication between the planner and executor.",
    f"{R_I} = {EXEC} + {COMM} + t<sup>i</sup><sub>plan+residual</sub> + 2 {SWITCH}, where {COMM} = "
    "t<sup>i</sup><sub>il-comm</sub> + t<sup>i</sup><sub>e,p-comm</sub>",
    "The margin is t<sub>plan+residual</sub>: what a cycle has left for planning, in a cycle with"
    " an update.",
    Biting("fig3", settings_of("fig3", 3.0), "figure 3 with X = 3 ms"),
)
SMALL = PaperEquation(
    "3.10",
    "the update of the plan is small",
    "The amount of time allotted for the critical section must only be a fractional amount of the"
    " time used by the executor each cycle. This leads to the constraint that the planner to"
    " executor communication is small.",
    f"t<sup>i</sup><sub>e,p-comm</sub> ≪ {R_I}",
    "The paper gives no number for ≪. Here it is <code>timing.small_share</code>, by default a"
    " tenth of the cycle.",
    Biting(
        "fig2",
        ("timing.small_share=0.1",),
        "by the default of a tenth, the paper's own figure 2: 1 ms of update in a cycle of 8 ms",
    ),
)


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
        Path(found.pictures["residuals"]),
        "What the cycles of each level used of R<sub>i</sub>, and &alpha;.",
    )
    return replace(own, measured=[*own.measured, Columns(head, rows), plate])


RESPONSE = Chapter(
    name="3.1",
    title="System Response Time",
    intro=(
        "How long does the whole system take to respond? The paper means the immediate response,"
        " such as to a keyboard interrupt, not the time until a program is done."
    ),
    statements=(FITS.statement(), BOUND.statement(), SUM.statement(_sum_tested)),
)
LOW = Chapter(
    name="3.2",
    title="Low-Level Timing Requirements",
    intro=(
        "What is left of a cycle decides whether executor, planner and others can share a"
        " processor."
    ),
    statements=(EXECUTES.statement(), PARTS.statement(), RESIDUAL.statement(_residual_tested)),
)
HIGH = Chapter(
    name="3.3",
    title="Higher-Level Timing Requirements",
    intro=(
        "Planner and executor on one processor: the executor has the higher priority, the plan is"
        " updated in a critical section, and each cycle pays two context switches."
    ),
    statements=(GRID.statement(), TIGHT.statement(), WITH_PLANNER.statement(), SMALL.statement()),
)
