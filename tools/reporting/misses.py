"""Every miss of a run, by task and tick: what a miss changed, it changed from that tick on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rack.backplane.layout import Layout, TaskSpec
from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.tools.recording import Recording


def misses(recording: Recording, layout: Layout) -> list[dict[str, Any]]:
    """Return every miss in the trace, earliest first: task, tick, what ("late" or "skipped"), how many, and times.

    A skipped release leaves no record of its own: the next one tells how many there were.
    """
    found = [
        miss for task in layout.tasks for miss in _misses_of(task, recording.cycles.get(task.name, recording.no_cycles))
    ]
    return sorted(found, key=lambda miss: (miss["tick"], miss["task"]))


def _misses_of(task: TaskSpec, cycles: np.ndarray) -> list[dict[str, Any]]:
    found = []
    for index in np.flatnonzero(cycles["flags"] & (Flag.MISSED | Flag.SKIPPED)):
        cycle = cycles[index]
        if skipped := int(cycle["flags"]) >> SKIPPED_SHIFT:
            first = int(cycle["tick"]) - skipped * task.every
            found.append({"task": task.name, "tick": first, "what": "skipped", "count": skipped})
        if cycle["flags"] & Flag.MISSED:
            late_ms = float(cycle["start_ns"] - cycle["release_ns"]) * 1e-6
            took_ms = float(cycle["end_ns"] - cycle["start_ns"]) * 1e-6
            entry = {"task": task.name, "tick": int(cycle["tick"]), "what": "late", "count": 1}
            found.append({**entry, "started_ms": round(late_ms, 6), "took_ms": round(took_ms, 6)})
    return found


def counted(misses: Sequence[dict[str, Any]]) -> tuple[int, int]:
    """Return how many cycles ended late, and how many were skipped."""
    late, skipped = (sum(miss["count"] for miss in misses if miss["what"] == what) for what in ("late", "skipped"))
    return late, skipped
