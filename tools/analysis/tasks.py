"""What was measured of each task beside the equations: how late, how long, how often, and the load of each core."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.levels.timing.equations import residual_deviation_ns
from rack.tools.analysis.cycles import Cycles
from rack.tools.analysis.model import Model
from rack.tools.recording import Recording
from rack.tools.reporting.statistics import distribution

Document = dict[str, Any]
MS = 1e-6


def task_document(cycles: Cycles, model: Model) -> Document:
    """Return what was measured of one task, start-up left out, ms; lateness and response mean nothing in lockstep."""
    judged, is_lockstep = cycles.is_judged, model.is_lockstep
    rows, used = cycles.rows[judged], cycles.used_ns[judged]
    gaps = np.diff(rows["start_ns"])
    flags = rows["flags"]
    return {
        "role": cycles.task.role,
        "core": cycles.core,
        "priority": cycles.priority,
        "cycles": len(rows),
        "start_up": len(cycles.rows) - len(rows),
        "missed": int(np.count_nonzero(flags & Flag.MISSED)),
        "skipped": int((flags >> SKIPPED_SHIFT).sum()),
        "used_ms": distribution(used * MS),
        "execution_ms": distribution(cycles.process_ns[judged] * MS),
        "communication_ms": distribution(cycles.communication_ns[judged] * MS),
        "deviation_ms": round(deviation_ns(cycles) * MS, 6),
        "beside_ms": round(cycles.overhead_ns * MS, 6),
        "lateness_ms": None if is_lockstep else distribution((rows["start_ns"] - rows["release_ns"]) * MS),
        "response_ms": None if is_lockstep else distribution((rows["end_ns"] - rows["release_ns"]) * MS),
        "slice_ms": model.slice_ns(cycles.task) * MS,
        "largest_gap_ms": None if is_lockstep or not len(gaps) else round(float(gaps.max()) * MS, 6),
    }


def deviation_ns(cycles: Cycles) -> float:
    """Return the standard deviation of the residual from cycle to cycle (eq. 3.6), ns."""
    judged = cycles.is_judged
    return residual_deviation_ns(cycles.process_ns[judged].tolist(), cycles.communication_ns[judged].tolist())


def core_loads(recording: Recording, found: Mapping[str, Cycles], model: Model) -> dict[int, float]:
    """Return by core the part of its time for which tasks used it, the clock's own not counted.

    An executor counts with all its releases, those that it skipped too: so that of a core with too much to do it
    comes out by how much.
    """
    loads: dict[int, float] = {}
    for name, cycles in found.items():
        rows = recording.cycles[name]
        if cycles.task.role == "executor":
            load = float(rows["processor_ns"].mean()) / model.cycle_ns(cycles.task)
        else:
            load = int(rows["processor_ns"].sum()) / _lasted_ns(recording, model)
        loads[cycles.core] = loads.get(cycles.core, 0.0) + load
    return dict(sorted(loads.items()))


def _lasted_ns(recording: Recording, model: Model) -> int:
    """Return how long the run lasted, ns: in lockstep its simulated time."""
    first = min(int(rows["tick"][0]) for rows in recording.cycles.values())
    last = max(int(rows["tick"][-1]) for rows in recording.cycles.values())
    return (last - first + 1) * model.tick_ns
