"""Section 4 of the paper: NIST's earlier controller, NASREM and its figures, and figure 5."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rack.boards.config import RackConfig, load
from rack.tools.lab.benches.partition import LevelFigures, TaskFigures
from rack.tools.lab.benches.switch import PAPER_US
from rack.tools.lab.reproduction.experiments import tables
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.measured import PARTITION, SWITCH
from rack.tools.lab.reproduction.experiments.nasrem import NAME, NASREM
from rack.tools.lab.reproduction.experiments.tables import TABLES
from rack.tools.lab.reproduction.sections.equations import forecast_of
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
from rack.tools.timing.charts import figure5

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
        " task twice in lockstep: with what moves in the cell, a pusher that shoves a block along"
        " while the arm reaches for it, and without.",
    ]


def _tables_of(config: RackConfig, board: str) -> str | None:
    """Return the files of a board's state tables; None where it has none."""
    named = config.board[board].params.get("tables", {})
    return code(", ".join(Path(path).name for path in named.values())) if named else None


def _earlier_tested(findings: Findings) -> Assessment:
    found = findings.of(TABLES)
    disturbed = found.disturbed
    calm = found.undisturbed
    usual = {(level, row.name) for level, rows in calm.rows.items() for row in rows}
    extra = [
        (level, text(row.name), row.cycles, f"{row.first_s:g}")
        for level, rows in disturbed.rows.items()
        for row in rows
        if (level, row.name) not in usual
    ]
    counts = [
        (level, len(rows), sum(row.cycles for row in rows))
        for level, rows in disturbed.rows.items()
    ]
    side: Side = [
        Columns(("level", "rows that fired", "cycles"), counts),
        Columns(
            ("level", "row", "cycles", "first at, s"),
            extra,
            "Rows that fired only in the run with the disturbance.",
        ),
    ]
    if not (disturbed.worked and calm.worked):
        return Assessment(side, Ruling.FAILS, "A task was not done.")
    if not extra:
        return Assessment(side, Ruling.FAILS, "No state transition answered the disturbance.")
    why = (
        "The task is done with the disturbance and without; transitions of its own answered the"
        " disturbance."
    )
    return Assessment(side, Ruling.HOLDS, why)


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


def _levels_tested(findings: Findings) -> Assessment:
    found = findings.of(NASREM)
    config = load(NAME)
    lasted_s = found.ticks * config.clock_ns * 1e-9
    rows = []
    off = []
    for name, task in found.executors.items():
        nominal = 1e9 / (config.every(name) * config.clock_ns)
        done = task.cycles + task.start_up + task.stalled
        due = -(-found.ticks // config.every(name))
        if done < (1 - NOMINAL) * due:
            off.append(name)
        rows.append(
            (
                name,
                f"{nominal:g}",
                f"{nominal * done / due:.2f}",
                f"{1e3 * task.lateness_ms.p50:.0f}",
                f"{1e3 * task.lateness_ms.p99:.0f}",
                f"{task.largest_gap_ms:.2f}",
                task.core,
            )
        )
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
    side: Side = [Columns(head, rows), words]
    if not off:
        return Assessment(
            side,
            Ruling.HOLDS,
            f"All rates are those of the paper and the config, within {100 * NOMINAL:g} %.",
        )
    return Assessment(
        side,
        Ruling.BOUNDED,
        f"More than {100 * NOMINAL:g} % below its rate: {', '.join(off)}; cycles were skipped.",
    )


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


def _switch_tested(findings: Findings) -> Assessment:
    found = findings.of(SWITCH)
    rows = [
        (name, *(f"{times[part]:.1f}" for part in ("min", "p50", "p99", "max")))
        for name, times in (
            ("planner to executor", found.in_us),
            ("executor to planner", found.out_us),
            ("t<sub>cs</sub>, half of both", found.switch_us),
        )
    ]
    head = ("us", "least", "median", "99th percentile", "longest")
    side: Side = [Columns(head, rows, f"Of {found.wakes} switches.")]
    median = found.switch_us["p50"]
    assumed = 1e3 * load(NAME).timing.context_switch_ms
    why = (
        "NIST's 68020 boards cannot be measured any more. On this machine a switch takes"
        f" {median:.0f} us, {PAPER_US / median:.1f} times less than theirs; the 99th percentile,"
        f" {found.switch_us['p99']:.0f} us, compares with the {assumed:g} us of the config."
    )
    return Assessment(side, Ruling.BOUNDED, why)


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


def _figure5_tested(findings: Findings) -> Assessment:
    """Compare partitions: do slow levels do with multitasking, and do fast ones need more?"""
    found = findings.of(PARTITION)
    slow = {
        one.level
        for one in figure5.placed(load(NAME))
        if figure5.region_of(one.cycle_s).name == "multitasking"
    }
    rows = []
    slow_tasks: list[TaskFigures] = []
    sharing: list[TaskFigures] = []
    apart: list[TaskFigures] = []
    for one in found.partitions:
        fast_tasks = sharing if one.partition.startswith("tight") else apart
        for level in one.levels:
            rows.append(_partition_row(one.partition, level))
            group = slow_tasks if level.level in slow else fast_tasks
            group += filter(None, (level.executor, level.planner))
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
    side: Side = [Columns(head, rows, words)]
    said = (
        "of the cycles and plans of levels from a quarter of a second up"
        f" {100 * _missed(slow_tasks):.1f} % were missed; of those below,"
        f" {100 * _missed(sharing):.1f} % with planners on the same processor, and"
        f" {100 * _missed(apart):.1f} % with planners on boards of their own."
    )
    if _missed(slow_tasks) > FEW:
        return Assessment(side, Ruling.FAILS, f"Against the figure, {said}")
    if _missed(sharing) <= _missed(apart) + FEW:
        why = (
            "As the figure says, slow levels do with multitasking. On this machine fast ones need"
            " no more either: "
        )
        return Assessment(side, Ruling.BOUNDED, f"{why}{said}")
    return Assessment(
        side, Ruling.HOLDS, f"Slow levels do with multitasking, fast ones do not: {said}"
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
        Statement("state-tables", (TABLES,), _earlier, _earlier_tested),
        Statement("nasrem", (NASREM,), _levels, _levels_tested),
        Statement("context-switch", (SWITCH,), _switch, _switch_tested),
        Statement("figure-5", (PARTITION,), _figure5, _figure5_tested),
    ),
)
