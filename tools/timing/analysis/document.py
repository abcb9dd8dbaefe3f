"""An analysis as plain data: analysis.json."""

from __future__ import annotations

from rack.levels.timing.level import LevelTiming
from rack.levels.timing.rack import RackTiming
from rack.levels.timing.trace_times import counts, distribution
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.console.answer import Document
from rack.tools.recording.cycles import START_UP_S, Cycles
from rack.tools.timing.analysis.analysis import MOSTLY, Analysis
from rack.tools.timing.analysis.task_times import MS, task_times

_Side = LevelTiming | EquationVerdict | None


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
            name: _sides(analysis.predicted.levels.get(name), analysis.measured.levels.get(name))
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
