"""Misses of a run that came while the hypervisor had the core: not the rack's own lateness."""

from __future__ import annotations

from typing import Any

import numpy as np

from rack.backplane.layout import Layout
from rack.backplane.trace import Flag
from rack.tools.recording import Recording


def steal(recording: Recording, layout: Layout) -> dict[str, Any]:
    """Return what was stolen, ms by core, and how many of the traced misses fell into it.

    A miss counts when its cycle, from its release to its end, overlaps a look in which the steal of its core rose.
    """
    stolen_ms: dict[str, int] = {}
    for found in recording.stolen:
        stolen_ms[str(found.core)] = stolen_ms.get(str(found.core), 0) + found.ms
    missed = during = 0
    counted = recording.ended.get("tasks", {})
    for task in layout.tasks:
        cycles = recording.cycles.get(task.name, recording.no_cycles)
        late = cycles[cycles["flags"] & Flag.MISSED != 0]
        core = counted.get(task.name, {}).get("core", task.core)
        spans = [(span.from_ns, span.to_ns) for span in recording.stolen if span.core == core]
        inside = np.zeros(len(late), bool)
        for from_ns, to_ns in spans:
            inside |= (late["release_ns"] <= to_ns) & (late["end_ns"] >= from_ns)
        missed += len(late)
        during += int(inside.sum())
    return {"ms": stolen_ms, "missed": missed, "missed_during": during}
