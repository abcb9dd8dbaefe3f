"""An analysis as plain data."""

from __future__ import annotations

from dataclasses import asdict
from math import isfinite
from typing import Any

from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.analysis.analysis import MOSTLY, Analysis
from rack.tools.analysis.breaches import Breach
from rack.tools.analysis.comparison import Pair
from rack.tools.analysis.cycles import START_UP_S, restarts
from rack.tools.analysis.summary import summary
from rack.tools.analysis.tasks import core_loads, task_document
from rack.tools.reporting.response import system_response

Document = dict[str, Any]


def document(analysis: Analysis) -> Document:
    """Return everything as plain data; what is infinite is null."""
    recording, config, model = analysis.recording, analysis.config, analysis.model
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
        "holds": analysis.holds,
        "levels": {name: _level(analysis, name) for name in config.board},
        "tasks": {name: task_document(cycles, model) for name, cycles in analysis.cycles.items()},
        "core_loads": {f"core {core}": load for core, load in core_loads(recording, analysis.cycles, model).items()},
        "restarts": restarts(recording),
        "equations": [_pair(pair) for pair in analysis.pairs],
        "mostly": {
            "percentile": MOSTLY,
            "failed": [{"equation": p.equation, "subject": p.subject} for p in analysis.mostly if p.fails],
        },
        "system_response": system_response(recording, config, recording.layout),
        "breaches": [_breach(breach, recording.layout.clock_ns) for breach in analysis.breaches],
    }


def _level(analysis: Analysis, board: str) -> Document:
    sides = {"predicted": analysis.predicted.get(board), "measured": analysis.measured.get(board)}
    told = {side: None if timing is None else timing.document() for side, timing in sides.items()}
    return {"summary": summary(analysis, board), **told}


def _pair(pair: Pair) -> Document:
    return {
        "equation": pair.equation,
        "subject": pair.subject,
        "predicted": _verdict(pair.predicted),
        "measured": _verdict(pair.measured),
        "disagrees": pair.disagrees,
    }


def _verdict(verdict: EquationVerdict | None) -> Document | None:
    if verdict is None:
        return None
    told = asdict(verdict) | {"margin": verdict.margin}
    del told["equation"], told["subject"]
    return {name: value if not isinstance(value, float) or isfinite(value) else None for name, value in told.items()}


def _breach(breach: Breach, clock_ns: int) -> Document:
    return {
        "task": breach.task,
        "tick": breach.tick,
        "time_s": round(breach.tick * clock_ns * 1e-9, 6),
        "start_up": breach.is_start_up,
        "equations": [asdict(broken) for broken in breach.broken],
        "core": asdict(breach.company) | {"text": breach.company.text()},
    }
