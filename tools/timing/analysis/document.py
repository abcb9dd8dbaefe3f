"""An analysis as plain data: analysis.json."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

import numpy as np

from rack.levels.timing.equations import plan_cycles_tight
from rack.levels.timing.level import LevelTiming
from rack.levels.timing.rack import RackTiming
from rack.levels.timing.trace_times import counts, distribution
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.console.answer import Document
from rack.tools.recording.cycles import START_UP_S, Cycles
from rack.tools.timing.analysis.analysis import MOSTLY, Analysis
from rack.tools.timing.analysis.task_times import MS, task_times

_Side = LevelTiming | EquationVerdict | None
UNITS = {"R": "read", "X": "execution", "W": "write", "C": "exchange", "P": "plan", "U": "update"}
"""Unit functions, and the names of their times in `LevelTiming`."""


def document(analysis: Analysis) -> Document:
    """Return everything as plain data; infinite numbers are null. report.json has restarts and
    the system's response."""
    recording = analysis.recording
    config = analysis.config
    return {
        "rack": config.name,
        "folder": str(recording.folder),
        "mode": config.clock.mode,
        "speed": config.clock.speed,
        "clock_ms": config.clock.period_ms,
        "context_switch_ms": config.timing.context_switch_ms,
        "percentile": analysis.percentile,
        "start_up_s": START_UP_S,
        "rows_lost": {name: count for name, count in recording.lost.items() if count},
        "gaps": [gap._asdict() for gap in recording.gaps()],
        "untraced": recording.untraced(),
        "kept": recording.kept_text or None,
        "holds": analysis.holds,
        "levels": {
            name: {
                "summary": summary(analysis, name),
                **_sides(analysis.predicted.levels.get(name), analysis.measured.levels.get(name)),
            }
            for name in config.board
        },
        "tasks": {
            name: task_document(cycles, analysis.predicted)
            for name, cycles in analysis.cycles.items()
        },
        "core_loads": {f"core {core}": load for core, load in analysis.loads.items()},
        "equations": [
            {
                "equation": pair.equation,
                "subject": pair.subject,
                **_sides(pair.predicted, pair.measured),
                "disagrees": pair.disagrees,
            }
            for pair in analysis.pairs
        ],
        "mostly": {
            "percentile": MOSTLY,
            "failed": [
                {"equation": p.equation, "subject": p.subject} for p in analysis.mostly if p.fails
            ],
        },
    }


def _sides(predicted: _Side, measured: _Side) -> Document:
    sides = {"predicted": predicted, "measured": measured}
    return {side: None if found is None else found.document() for side, found in sides.items()}


def task_document(cycles: Cycles, rack: RackTiming) -> Document:
    """Return the times of the judged cycles of one task, ms, as `task_times` of their processor
    times."""
    judged = cycles.is_judged
    rows = cycles.rows[judged]
    missed, skipped = counts(rows)
    return {
        "role": cycles.task.role,
        "core": cycles.core,
        "priority": cycles.priority,
        "cycles": len(rows),
        "start_up": len(cycles.rows) - len(rows) - cycles.stalled,
        "stalled": cycles.stalled,
        "missed": missed,
        "skipped": skipped,
        "used_ms": distribution(cycles.used_ns[judged] * MS),
        "beside_ms": round(cycles.overhead_ns * MS, 6),
        **task_times(
            cycles.task,
            rows,
            rack.tick_ns,
            rack.is_lockstep,
            stretches=cycles.stretches[judged],
            parts_ns=(cycles.process_ns[judged], cycles.communication_ns[judged]),
        ),
    }


def summary(analysis: Analysis, board: str) -> str:
    """Return in one line the use of a level's cycle, whether its planner fits, and where it exceeds
    its budget."""
    timing = analysis.measured.levels.get(board)
    if timing is None:
        return "never ran"
    return "; ".join(_clauses(analysis, timing))


def worst_words(percentile: float) -> str:
    """Return a percentile in words: "in the worst cycle", or "in 99 of 100 cycles"."""
    return "in the worst cycle" if percentile >= 100 else f"in {percentile:g} of 100 cycles"


def _clauses(analysis: Analysis, timing: LevelTiming) -> Iterator[str]:
    used_ns = timing.execution_ns + timing.communication_ns
    usual_ns = float(np.median(analysis.cycles[timing.board].used_ns))
    when = worst_words(analysis.percentile)
    yield (
        f"{brief_ms(used_ns)} of {brief_ms(timing.cycle_ns)} ms used {when}, {brief_ms(usual_ns)}"
        " usually"
    )
    if timing.planning_ns is not None:
        yield _planner(timing, analysis.measured.context_switch_ns)
    elif timing.coupling != "none":
        yield "its planner made no plan"
    budget = analysis.predicted.levels.get(timing.board)
    if over := [] if budget is None else list(_over(timing, budget)):
        yield f"over its budget: {', '.join(over)}"


def _planner(timing: LevelTiming, switch_ns: int) -> str:
    planning_ns = timing.planning_ns or 0
    permitted = timing.within_cycles
    if timing.coupling == "loose":
        needed: int | None = max(1, ceil(planning_ns / timing.cycle_ns))
        place = "on its own processor"
    else:
        needed = plan_cycles_tight(planning_ns, timing.residual_ns, switch_ns)
        place = "on the same processor"
    took = f"a plan takes {brief_ms(planning_ns)} ms {place}"
    if needed is None:
        return f"{took}, and no time is left for it in such a cycle"
    fits = needed <= (permitted or 0)
    return (
        f"{took}: {f'fits into {needed} of its' if fits else f'needs {needed} and has'} {permitted}"
        " cycles"
    )


def brief_ms(ns: float) -> str:
    """Return a time in ms with three digits."""
    ms = ns * 1e-6
    return f"{ms:.0f}" if ms >= 100 else f"{ms:.3g}"


def _over(timing: LevelTiming, budget: LevelTiming) -> Iterator[str]:
    for unit, name in UNITS.items():
        took, permitted = (getattr(side, f"{name}_ns") or 0 for side in (timing, budget))
        if took > permitted:
            yield f"{unit} {brief_ms(took)} of {brief_ms(permitted)} ms"
