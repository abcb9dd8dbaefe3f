"""Section 4 of the paper: NIST's earlier controller, NASREM and its figures, and figure 5."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rack.boards.config import RackConfig, load
from rack.tools.lab.reproduction.experiments import tables
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.nasrem import (
    NAME,
    NASREM,
    ExecutorCycles,
    NasremRun,
)
from rack.tools.lab.reproduction.experiments.partition import (
    PARTITION,
    LevelFigures,
    Partitions,
    TaskFigures,
)
from rack.tools.lab.reproduction.experiments.switch import PAPER_US, SWITCH, SwitchRun
from rack.tools.lab.reproduction.experiments.tables import TABLES, FiredRow, TableRuns
from rack.tools.lab.reproduction.sections.comparison import HOSTS
from rack.tools.lab.reproduction.sections.equations import forecast_of, stolen
from rack.tools.lab.reproduction.sections.page import (
    DONE,
    Chapter,
    ClaimVerdict,
    Columns,
    Plate,
    Requirement,
    Row,
    Ruling,
    Side,
    Statement,
    code,
    ruled,
    text,
)
from rack.tools.timing.charts import figure5

PAPER_HZ = {"servo": 400.0, "primitive": 50.0}
"""Rates that the paper gives."""
NOMINAL = 0.01
"""Part by which a measured rate may differ from its nominal value: skipped cycles lower it."""
FEW = 0.01
"""Part of cycles, or plans, missed up to which they are called stray ones."""


def _earlier(workshop: Workshop) -> Side:
    config = load(tables.NAME)
    planners = [name for name, board in config.board.items() if board.planner]
    rows = [
        (
            name,
            f"{config.every(name) * config.clock_ns * 1e-6:g}",
            _tables_of(config, name),
            "yes" if name in planners else "no",
        )
        for name in config.board
    ]
    cycles = {config.every(name) for name in config.board if _tables_of(config, name)}
    same = "one and the same" if len(cycles) == 1 else "different"
    return [
        Columns(("level", "cycle", "its state tables", "planner"), rows),
        f"The levels with state tables have {same} cycle. Levels with a planner:"
        f" {', '.join(planners) or 'none'}; plans are poses and places in the tables. We run the"
        " task twice: in real time with what moves in the cell, a pusher that shoves a block along"
        " while the arm reaches for it, and in lockstep without.",
    ]


def _tables_of(config: RackConfig, board: str) -> str | None:
    """Return the files of a board's state tables; None where it has none."""
    named = config.board[board].params.get("tables", {})
    return code(", ".join(Path(path).name for path in named.values())) if named else None


def _answers(found: TableRuns) -> list[tuple[str, FiredRow]]:
    """Return the rows that fired only in the run with the disturbance, with their levels."""
    usual = {(level, row.name) for level, rows in found.undisturbed.rows.items() for row in rows}
    return [
        (level, row)
        for level, rows in found.disturbed.rows.items()
        for row in rows
        if (level, row.name) not in usual
    ]


def _earlier_measured(workshop: Workshop, found: TableRuns) -> Side:
    extra = [
        (level, text(row.name), row.cycles, f"{row.first_s:g}") for level, row in _answers(found)
    ]
    counts = [
        (level, len(rows), sum(row.cycles for row in rows))
        for level, rows in found.disturbed.rows.items()
    ]
    return [
        Columns(("level", "rows that fired", "cycles"), counts),
        Columns(
            ("level", "row", "cycles", "first at, s"),
            extra,
            "Rows that fired only in the run with the disturbance.",
        ),
    ]


def judge_tables(found: TableRuns) -> ClaimVerdict:
    """Compare the state transitions of a run with a disturbance with those of a run without."""
    undone = sum(not run.worked for run in (found.disturbed, found.undisturbed))
    return ruled(
        (
            Requirement("tasks not done", undone, "=", 0),
            Requirement("transitions only with the disturbance", len(_answers(found)), ">=", 1),
        ),
        "The task is done with the disturbance, in real time, and without; transitions of its own"
        " answered the disturbance.",
    )


def _levels(workshop: Workshop) -> Side:
    config = load(NAME)
    coupled = {"tight": "tightly", "loose": "loosely", "none": "-"}
    rows = []
    for name, board in config.board.items():
        rate = f"{1e9 / (config.every(name) * config.clock_ns):g}"
        planner_core = board.planner_core
        if planner_core is None and board.planner:
            planner_core = board.core
        rows.append((name, rate, board.core, board.priority, coupled[board.coupling], planner_core))
    head = ("level", "rate, Hz", "processor", "priority", "planner coupled", "planner's processor")
    caption = f"From the config of {code(NAME)}. The planners have no real-time priority."
    return [Columns(head, rows, caption)]


def _rates(found: NasremRun) -> Iterator[tuple[str, ExecutorCycles, float, float]]:
    """Yield every level with its cycles, its rate in the paper or else in the config, and that of
    the run, Hz."""
    config = load(NAME)
    for name, task in found.executors.items():
        own_hz = 1e9 / (config.every(name) * config.clock_ns)
        done = task.cycles + task.start_up + task.stalled
        due = -(-found.ticks // config.every(name))
        yield name, task, PAPER_HZ.get(name, own_hz), own_hz * done / due


def _levels_measured(workshop: Workshop, found: NasremRun) -> Side:
    lasted_s = found.ticks * load(NAME).clock_ns * 1e-9
    rows = [
        (
            name,
            f"{nominal_hz:g}",
            f"{rate_hz:.2f}",
            f"{1e3 * task.lateness_ms.p50:.0f}",
            f"{1e3 * task.lateness_ms.p99:.0f}",
            f"{task.largest_gap_ms:.2f}",
            task.core,
        )
        for name, task, nominal_hz, rate_hz in _rates(found)
    ]
    head = (
        "level",
        "rate, Hz",
        "measured",
        "start late, median, us",
        "99th percentile",
        "longest gap, ms",
        "processor",
    )
    accesses = sum(bus.reads + bus.writes for bus in found.bus.values()) / lasted_s
    size = sum(bus.read_bytes + bus.write_bytes for bus in found.bus.values()) / lasted_s
    words = f"Over the backplane go {accesses:.0f} reads and writes a second, {size / 1e6:.2f} MB."
    return [Columns(head, rows), f"{words} {stolen(found)}"]


def judge_levels(found: NasremRun) -> ClaimVerdict:
    """Compare the rates of the levels with the paper's, and the gaps between their cycles with two
    periods: from there on a cycle was left out."""
    rates = [Requirement("whole tasks done", int(found.ended == DONE), "=", 1)]
    gaps = []
    for name, task, nominal_hz, rate_hz in _rates(found):
        off = abs(rate_hz / nominal_hz - 1.0)
        rates.append(Requirement(f"{name}: part off {nominal_hz:g} Hz", off, "<=", NOMINAL))
        periods_ms = 2.0 * task.slice_ms
        gaps.append(Requirement(f"{name}: longest gap", task.largest_gap_ms, "<", periods_ms, "ms"))
    why = (
        f"All rates are those of the paper, within {100 * NOMINAL:g} %, and no cycle was left out."
    )
    return ruled((*rates, *gaps), why, here=rates)


def _switch(workshop: Workshop) -> Side:
    setting = f"timing.context_switch_ms={PAPER_US * 1e-3:g}"
    rows = []
    for settings in ((), (setting,)):
        config = load(NAME, settings)
        failing = ", ".join(
            f"{verdict.equation} ({verdict.subject})"
            for verdict in forecast_of(config).verdicts
            if not verdict.holds
        )
        rows.append((f"{1e3 * config.timing.context_switch_ms:g}", text(failing) or "none"))
    head = ("t<sub>cs</sub>, us", f"what fails in {code(NAME)}")
    caption = (
        "By the budgets of the config; the second row has the paper's task switch"
        f" ({code(setting)})."
    )
    return [Columns(head, rows, caption)]


def _switch_measured(workshop: Workshop, found: SwitchRun) -> Side:
    cost = found.cost
    rows = [
        (name, *(f"{times[part]:.1f}" for part in ("min", "p50", "p99", "max")))
        for name, times in (
            ("planner to executor", cost.in_us),
            ("executor to planner", cost.out_us),
            ("t<sub>cs</sub>, half of both", cost.switch_us),
        )
    ]
    head = ("us", "least", "median", "99th percentile", "longest")
    return [Columns(head, rows, f"Of {cost.wakes} switches.")]


def judge_switch(found: SwitchRun) -> ClaimVerdict:
    """Compare this machine's switch with the paper's, and with what the config assumes."""
    times_us = found.cost.switch_us
    median = times_us["p50"]
    why = (
        "NIST's 68020 boards cannot be measured any more. On this machine a switch takes"
        f" {median:.0f} us, {PAPER_US / median:.1f} times less than theirs."
    )
    return ruled(
        (
            Requirement("median, the paper's", median, "<=", PAPER_US, "us"),
            Requirement(
                "99th percentile, the config's", times_us["p99"], "<=", found.assumed_us, "us"
            ),
        ),
        why,
        holding=Ruling.BOUNDED,
    )


def _figure5(workshop: Workshop) -> Side:
    config = load(NAME)
    path = workshop.shown(figure5.save(config, workshop.picture("figure5")))
    rows = [
        (one.level, figure5.duration(one.cycle_s), text(one.region), text(one.coupling))
        for one in figure5.placed(config)
    ]
    caption = f"The levels of {code(NAME)} among the paper's regions."
    return [
        Plate(path, caption),
        Columns(("level", "cycle", "the figure suggests", "planner here"), rows),
    ]


def _figure5_measured(workshop: Workshop, found: Partitions) -> Side:
    rows = [
        _partition_row(one.partition, level) for one in found.partitions for level in one.levels
    ]
    head = (
        "partition",
        "level",
        "predicted to fit",
        "cycles",
        "missed or skipped",
        "plans",
        "late",
        "plan's age, ms, longest",
    )
    words = f"Each partition ran {code(NAME)} for {found.seconds:g} s in real time."
    return [Columns(head, rows, words)]


def judge_figure5(found: Partitions) -> ClaimVerdict:
    """Compare what levels miss by partition: do slow levels do with multitasking, and do fast ones
    need more?"""
    slow = {
        one.level
        for one in figure5.placed(load(NAME))
        if figure5.region_of(one.cycle_s).name == "multitasking"
    }
    groups: dict[str, list[TaskFigures]] = {"slow": [], "tight": [], "loose": []}
    plans = []
    for one in found.partitions:
        coupling = one.partition.partition(",")[0]
        for level in one.levels:
            group = groups["slow" if level.level in slow else coupling]
            group += filter(None, (level.executor, level.planner))
            if level.planner is not None:
                plans.append(level.planner.cycles)
    missed = {name: _missed(tasks) for name, tasks in groups.items()}
    slow_ones = Requirement("slow levels: part missed", missed["slow"], "<=", FEW)
    more = missed["loose"] + FEW
    return ruled(
        (
            slow_ones,
            Requirement("fast levels, multitasking: part missed", missed["tight"], ">", more),
        ),
        "As the figure says, slow levels do with multitasking, and fast ones do not.",
        here=(slow_ones,),
        needs=(Requirement("plans of the level with the fewest", min(plans, default=0), ">=", 1),),
    )


def _missed(tasks: Sequence[TaskFigures]) -> float:
    """Return the part of the cycles and plans of these tasks that were missed or skipped."""
    due = sum(task.cycles for task in tasks)
    return sum(task.missed + task.skipped for task in tasks) / due if due else 0.0


def _partition_row(partition: str, level: LevelFigures) -> Row:
    executor = level.executor
    planner = level.planner
    plans = None if planner is None else planner.cycles
    late = None if planner is None else planner.missed
    age = level.plan_age_ms
    oldest = None if age is None else f"{age['max']:g}"
    fits = [task.fits for task in filter(None, (executor, planner)) if task.fits is not None]
    return (
        partition,
        level.level,
        all(fits) if fits else None,
        executor.cycles,
        executor.missed + executor.skipped,
        plans,
        late,
        oldest,
    )


CHAPTER = Chapter(
    "4",
    (
        Statement("state-tables", (TABLES,), judge_tables, _earlier, _earlier_measured),
        Statement("nasrem", (NASREM,), judge_levels, _levels, _levels_measured),
        Statement("context-switch", (SWITCH,), judge_switch, _switch, _switch_measured),
        HOSTS,
        Statement("figure-5", (PARTITION,), judge_figure5, _figure5, _figure5_measured),
    ),
)
