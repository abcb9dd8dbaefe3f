"""An analysis as plain data: analysis.json."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from math import ceil

import numpy as np

from rack.levels.timing.equations import plan_cycles_tight, residual_deviation_ns
from rack.levels.timing.level import LevelTiming
from rack.levels.timing.rack import RackTiming
from rack.levels.timing.trace_times import counts, distribution, gaps_ns, lateness_ns, response_ns
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.console.answer import Document
from rack.tools.recording.cycles import START_UP_S, Cycles, restarts
from rack.tools.timing.analysis.analysis import MOSTLY, Analysis, Pair
from rack.tools.timing.analysis.breaches import Breach, brief_ms
from rack.tools.timing.analysis.rules import slice_ns

MS = 1e-6
UNITS = {"R": "read", "X": "execution", "W": "write", "C": "exchange", "P": "plan", "U": "update"}
"""Unit functions, and the names of their times in `LevelTiming`."""


def document(analysis: Analysis) -> Document:
    """Return everything as plain data; infinite numbers are null."""
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
        "levels": {name: _level(analysis, name) for name in config.board},
        "tasks": {
            name: task_document(cycles, analysis.predicted)
            for name, cycles in analysis.cycles.items()
        },
        "core_loads": {f"core {core}": load for core, load in analysis.loads.items()},
        "restarts": restarts(recording),
        "equations": [_pair(pair) for pair in analysis.pairs],
        "mostly": {
            "percentile": MOSTLY,
            "failed": [
                {"equation": p.equation, "subject": p.subject} for p in analysis.mostly if p.fails
            ],
        },
        "system_response": analysis.response,
        "breaches": [_breach(breach, recording.layout.clock_ns) for breach in analysis.breaches],
    }


def _level(analysis: Analysis, board: str) -> Document:
    sides = {
        "predicted": analysis.predicted.levels.get(board),
        "measured": analysis.measured.levels.get(board),
    }
    timings = {
        side: None if timing is None else timing.document() for side, timing in sides.items()
    }
    return {"summary": summary(analysis, board), **timings}


def _pair(pair: Pair) -> Document:
    return {
        "equation": pair.equation,
        "subject": pair.subject,
        "predicted": None if pair.predicted is None else _without_subject(pair.predicted),
        "measured": None if pair.measured is None else _without_subject(pair.measured),
        "disagrees": pair.disagrees,
    }


def _without_subject(verdict: EquationVerdict) -> Document:
    return {
        name: value
        for name, value in verdict.document().items()
        if name not in ("equation", "subject")
    }


def _breach(breach: Breach, clock_ns: int) -> Document:
    return {
        "task": breach.task,
        "tick": breach.tick,
        "time_s": round(breach.tick * clock_ns * 1e-9, 6),
        "judged": breach.is_judged,
        "equations": [asdict(broken) for broken in breach.broken],
        "core": asdict(breach.sharing) | {"text": breach.sharing.text()},
    }


def task_document(cycles: Cycles, rack: RackTiming) -> Document:
    """Return the times of the judged cycles of one task, ms; lateness and response are None in
    lockstep."""
    judged = cycles.is_judged
    is_lockstep = rack.is_lockstep
    rows = cycles.rows[judged]
    gaps = gaps_ns(rows, cycles.stretches[judged])
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
        "execution_ms": distribution(cycles.process_ns[judged] * MS),
        "communication_ms": distribution(cycles.communication_ns[judged] * MS),
        "deviation_ms": round(deviation_ns(cycles) * MS, 6),
        "beside_ms": round(cycles.overhead_ns * MS, 6),
        "lateness_ms": None if is_lockstep else distribution(lateness_ns(rows) * MS),
        "response_ms": None if is_lockstep else distribution(response_ns(rows) * MS),
        "slice_ms": slice_ns(rack, cycles.task) * MS,
        "largest_gap_ms": (
            None if is_lockstep or not len(gaps) else round(float(gaps.max()) * MS, 6)
        ),
    }


def deviation_ns(cycles: Cycles) -> float:
    """Return the standard deviation of the residual from cycle to cycle (eq. 3.6), ns."""
    judged = cycles.is_judged
    return residual_deviation_ns(
        cycles.process_ns[judged].tolist(), cycles.communication_ns[judged].tolist()
    )


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


def _over(timing: LevelTiming, budget: LevelTiming) -> Iterator[str]:
    for unit, name in UNITS.items():
        took, permitted = (getattr(side, f"{name}_ns") or 0 for side in (timing, budget))
        if took > permitted:
            yield f"{unit} {brief_ms(took)} of {brief_ms(permitted)} ms"
