"""Section 3.4 of the paper: figures 2 to 4, drawn, run, and with every X that the paper permits."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import (
    FIG2,
    FIG3,
    FIG4,
    LEAST_X,
    LEVEL,
    LONG_2,
    MOST_X,
    MS,
    OVERLOAD,
    PLANNER,
    SHORT_2,
    SHORT_3,
    FigureRack,
    FigureRun,
    Planning,
    budget_of,
    planning,
    sweep,
)
from rack.tools.lab.reproduction.sections.page import (
    STRAY,
    Chapter,
    ClaimVerdict,
    Columns,
    Listing,
    Plate,
    Requirement,
    Ruling,
    Side,
    Statement,
    code,
    ruled,
    ruled_strays,
)
from rack.tools.timing.charts.letters import column_for, lines

STEP_X = 0.5
LEAST_P = 3.0
""""The planner runs at least 3 ms each cycle"."""
WORST_CYCLES = 3
""""At worst an updated plan should be available every third cycle"."""
MOSTLY = 0.5
"""Part of the cycles, or plans, late from which on a run is said to fail: the figures fail in all,
or in none."""
PAPER_X = [LEAST_X + STEP_X * k for k in range(round((MOST_X - LEAST_X) / STEP_X) + 1)]


def drawn(figure: FigureRack, workshop: Workshop) -> tuple[Plate, Listing]:
    """Return a figure as the paper draws it, as a picture and as letters."""
    from rack.tools.timing.charts.picture import save

    panel = figure.panel()
    paths = save(
        [panel], f"{figure.label}: the schedule of its budget", workshop.picture(figure.label)
    )
    caption = (
        f"The schedule computed from the budget of {code(figure.label)}, drawn as in the paper."
    )
    column_ns = column_for(figure.window_ns, figure.schedule().shortest_ns)
    letters = "\n".join(lines(panel, column_ns))
    return Plate(workshop.shown(paths), caption), Listing(letters)


def ran(figure: FigureRack, found: FigureRun) -> Side:
    """Return the run of a figure: its chart, how many cycles and plans were late, and its
    patterns."""
    steal = ", ".join(f"core {core} {percent:g} %" for core, percent in found.steal.items())
    names = {LEVEL: "executor: cycles", PLANNER: "planner: plans"}
    rows = [
        (names[task], count.jobs, count.late, count.skipped) for task, count in found.tasks.items()
    ]
    patterns = [(one.lane, code(one.pattern), one.times) for one in found.patterns]
    caption = (
        "Late: past its deadline; skipped: of the late ones, those that never began. Taken by the"
        f" hypervisor meanwhile: {steal or 'not measured'}."
    )
    return [
        Plate(
            found.pictures["measured"],
            f"A run of {code(figure.label)} by real processes, from its middle.",
        ),
        Columns(("", "all", "late", "skipped"), rows, caption),
        Columns(
            ("processor of", "pattern", "times"),
            patterns,
            "The most frequent patterns, over the cycles of a plan.",
        ),
    ]


def late_part(found: FigureRun) -> float:
    """Return the larger part of cycles, or of plans, late."""
    return max(found.late(LEVEL), found.late(PLANNER))


def _undisturbed(found: FigureRun) -> list[Requirement]:
    """Return what a run needs to show the figure: an executor is late in almost all cycles, or in
    none."""
    late = found.late(LEVEL)
    return [Requirement("part of the executor's cycles late", late, "<=", STRAY)] * (late <= MOSTLY)


def judge_figure(works: bool, found: FigureRun) -> ClaimVerdict:
    """Rule on a figure of which the paper says that it works, or that it fails."""
    late = Requirement("part of cycles, or plans, late", late_part(found), ">", MOSTLY)
    count = sum(count.late for count in found.tasks.values())
    needs = _undisturbed(found)
    if not works:
        return ruled((late,), "It fails, as the paper says.", needs=needs)
    return ruled(
        (Requirement("cycles and plans late", count, "=", 0),),
        "It works, as the paper says.",
        here=(late._replace(sign="<="),),
        needs=needs,
    )


def judge_both(tight: FigureRun, loose: FigureRun) -> ClaimVerdict:
    """Compare the executors' late cycles with all, in runs in which planners made plans."""
    runs = (tight, loose)
    late = sum(run.tasks[LEVEL].late for run in runs)
    due = sum(run.tasks[LEVEL].jobs for run in runs)
    plans = min(run.tasks[PLANNER].jobs for run in runs)
    why = "No cycle of an executor was late, while a planner computed all the time."
    planned = Requirement("plans made, in the run with fewer", plans, ">=", 1)
    return ruled_strays("cycles of executors late", late, due, why, (planned,))


def ran_all(*figures: FigureRack) -> Callable[..., Side]:
    """Return what shows the runs of figures, one after the other."""

    def measured(workshop: Workshop, *found: FigureRun) -> Side:
        runs = zip(figures, found, strict=True)
        return [item for figure, run in runs for item in ran(figure, run)]

    return measured


def _predicted(figure: FigureRack, workshop: Workshop) -> Side:
    plate, letters = drawn(figure, workshop)
    found = planning(figure.config, budget_of(figure.loaded()).process_ms)
    about = (
        f"With X = {found.process_ms:g} ms a cycle leaves {found.idle_ms:g} ms after the executor. "
    )
    if found.failing:
        about += f"These fail: {', '.join(found.failing)}."
    else:
        about += "Every equation holds, and every cycle and plan is in time."
    return [plate, letters, about]


def _planning_table(rows: list[Planning]) -> Columns:
    head = (
        "X",
        "P a cycle, U in each",
        "plan after",
        "P and U a cycle, U once",
        "plan after",
        "permitted",
        "eqs that fail",
        "schedule",
        "in time",
    )
    cells = [
        (
            f"{one.process_ms:g}",
            f"{one.each_ms:g}",
            _in_cycles(one.cycles_each),
            f"{one.once_ms:g}",
            _in_cycles(one.cycles_once),
            _in_cycles(one.permitted),
            ", ".join(one.failing) or "none",
            code(one.pattern),
            one.in_time,
        )
        for one in rows
    ]
    return Columns(head, cells)


def _in_cycles(count: int | None) -> str:
    return "never" if count is None else f"{count} cycles"


def contradicting(rows: list[Planning]) -> list[Planning]:
    """Return the cases in which figure 2 does not do what the paper says of it.

    It says that the planner runs at least `LEAST_P` in each cycle, and that two cycles suffice for
    P and U.
    """
    return [one for one in rows if one.each_ms < LEAST_P or _is_slow(one)]


def _is_slow(one: Planning) -> bool:
    return one.cycles_once is None or one.cycles_once > one.permitted


def _sweep_side(workshop: Workshop) -> Side:
    """Compute both readings of the pattern for every X, and the largest X that each permits."""
    rows = sweep(FIG2.config, PAPER_X)
    config = FIG2.loaded()
    cycle_ms = config.every(LEVEL) * config.clock_ns * MS
    budget = budget_of(config)
    fixed_ms = budget.read_ms + budget.write_ms
    work_ms = budget.plan_ms + budget.update_ms
    worst = rows[-1]
    less = [one for one in rows if one.each_ms < LEAST_P]
    slow = [one for one in rows if _is_slow(one)]
    most_each = cycle_ms - fixed_ms - budget.update_ms - LEAST_P
    most_once = cycle_ms - fixed_ms - work_ms / worst.permitted
    literal = (
        'Read literally, "RXWPU" has U in every cycle, and P has '
        f"{cycle_ms - fixed_ms - budget.update_ms:g} &minus; X ms in each: at least {LEAST_P:g} ms"
        " up to X = "
        f"{most_each:g}. With X = {_values(less) or 'none'} it is less; "
        f"with X = {worst.process_ms:g} it is {worst.each_ms:g} ms, and a plan takes"
        f" {_in_cycles(worst.cycles_each)}, "
        f"{(worst.cycles_each or 0) * cycle_ms:g} ms instead of {worst.permitted * cycle_ms:g}."
    )
    kind = (
        f"Read kindly, there is one U for each plan, and P and U share {cycle_ms - fixed_ms:g}"
        f" &minus; X ms of a cycle. In {worst.permitted} cycles with X = {worst.process_ms:g} that"
        f" is {worst.permitted * worst.once_ms:g} ms, but P and U need {work_ms:g}: the plan is"
        f" computed in time, its update comes in cycle {worst.cycles_once}. Up to X = {most_once:g}"
        " two cycles would do; equation 3.8 demands less than that. Too slow: X ="
        f" {_values(slow) or 'none'}."
    )
    counts = (worst.cycles_each, worst.cycles_once)
    is_third = all(count is not None and count <= WORST_CYCLES for count in counts)
    demand = "met" if is_third else "not met"
    follows = (
        f"So the figure is what its text says as long as X is at most {most_each:g} ms, or at most"
        f" {most_once:g} on average over the cycles of a plan, whereas the paper permits"
        f" {MOST_X:g}. Its weaker demand, a plan at worst in every third cycle, is"
        f" {demand} with X = {worst.process_ms:g} in both readings."
    )
    return [_planning_table(rows), literal, kind, follows]


def _values(rows: list[Planning]) -> str:
    return ", ".join(f"{one.process_ms:g}" for one in rows)


def judge_sweep(short: FigureRun, long: FigureRun) -> ClaimVerdict:
    """Compare two sentences of the paper with each other, by computation and by two runs."""
    odd = contradicting(sweep(FIG2.config, PAPER_X))
    why = (
        '"X will range from 1 to 3 ms" and "the planner runs at least 3 ms each cycle" exclude'
        f" each other for X = {_values(odd)}. Runs agree with the computation."
    )
    return ruled(
        (
            Requirement("values of X for which both cannot be", len(odd), ">=", 1),
            Requirement(f"X = {LEAST_X:g}: part late", late_part(short), "<=", MOSTLY),
            Requirement(f"X = {MOST_X:g}: part late", late_part(long), ">", MOSTLY),
        ),
        why,
        holding=Ruling.CONTRADICTS,
    )


def _fig3_side(workshop: Workshop) -> Side:
    rows = sweep(FIG3.config, PAPER_X)
    works = [one for one in rows if not _is_slow(one)]
    text = (
        f"The failure depends on X. With X = {_values(works) or 'none'} three cycles are enough for"
        f" P and U; with X = {_values([one for one in rows if one not in works])} they are not."
    )
    return [*_predicted(FIG3, workshop), _planning_table(rows), text]


def judge_fig3(found: FigureRun, short: FigureRun) -> ClaimVerdict:
    """Compare plans with the usual X, and with the shortest that the paper permits."""
    usual = Requirement("part of cycles, or plans, late", late_part(found), ">", MOSTLY)
    return ruled(
        (usual, Requirement(f"the same with X = {LEAST_X:g}", late_part(short), ">", MOSTLY)),
        "It fails, as the paper says, with the shortest X too.",
        here=(usual,),
        needs=_undisturbed(found),
    )


def _fig4_side(workshop: Workshop) -> Side:
    rows = sweep(FIG4.config, PAPER_X)
    full = [one for one in rows if one.idle_ms <= 0]
    text = (
        'The "-" of the pattern is there up to X ='
        f" {max(one.process_ms for one in rows if one.idle_ms > 0):g} ms."
    )
    if full:
        text += (
            f" With X = {_values(full)} the executor fills its cycle: every cycle is still in time,"
            " but equation 3.6, 0 &lt; t<sub>residual</sub>, fails."
        )
    return [*_predicted(FIG4, workshop), text, _planning_table(rows)]


def _figure(
    name: str,
    figure: FigureRack,
    works: bool,
    predicted: Callable[[Workshop], Side] | None = None,
) -> Statement:
    return Statement(
        name,
        (figure.experiment,),
        partial(judge_figure, works),
        predicted or partial(_predicted, figure),
        ran_all(figure),
    )


CHAPTER = Chapter(
    "3.4",
    (
        _figure("figure-2", FIG2, works=True),
        Statement(
            "figure-2-x",
            (SHORT_2.experiment, LONG_2.experiment),
            judge_sweep,
            _sweep_side,
            ran_all(SHORT_2, LONG_2),
        ),
        Statement(
            "figure-3",
            (FIG3.experiment, SHORT_3.experiment),
            judge_fig3,
            _fig3_side,
            ran_all(FIG3, SHORT_3),
        ),
        _figure("figure-4", FIG4, works=True, predicted=_fig4_side),
        _figure("figure-4-overload", OVERLOAD, works=False),
    ),
)
