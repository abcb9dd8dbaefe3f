"""The response of the whole system, measured beside its bounds (eqs 3.2 and 3.3).

Every message carries the tick of the oldest information that it rests on: so the trace of a command can be
followed from the release of the highest level to the cycle of the lowest that acts on it, and a status up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from backplane.layout import Layout
from boards.config.schema import RackConfig
from tools.recording import Recording
from tools.reporting.statistics import Distribution, distribution
from tools.timing.prediction import hierarchy, predict


def system_response(recording: Recording, config: RackConfig, layout: Layout) -> dict[str, Any] | None:
    """Return the response down (commands) and up (statuses), in ticks and ms; None without a hierarchy."""
    levels = list(hierarchy(config))
    if len(levels) < 2:
        return None
    cycles, predicted = {name: layout.task(name).every for name in levels}, predict(config, layout)
    tick_ms = layout.clock_ns * 1e-6
    return {
        "levels": levels,
        "bound_eq_3_2_ms": predicted.bound_eq_3_2_ms,
        "sum_eq_3_3_ms": predicted.sum_eq_3_3_ms,
        "command": {
            "measured_ms": _way(recording, levels, "command", cycles, tick_ms),
            "bound_ms": predicted.command_ms,
        },
        "status": {
            "measured_ms": _way(recording, levels[::-1], "status", cycles, tick_ms),
            "bound_ms": predicted.status_ms,
        },
    }


def _way(
    recording: Recording, levels: Sequence[str], port: str, cycles: dict[str, int], tick_ms: float
) -> Distribution | None:
    """Return the response along `levels`: from the first one's release to the end of the last one's cycle.

    Counted for what happens just after a release whose message went all the way: it waits for the next that does.
    """
    first, last = cycles[levels[0]], cycles[levels[-1]]
    mailbox = f"{levels[-2]}.{port}"
    basis, visible_at = recording.signal(mailbox, "basis"), recording.signal(mailbox, "visible_at")
    # Before the first one's messages have come along, the later levels' rest on their own ticks.
    real = basis >= first
    arrived, at = np.unique(basis[real], return_index=True)
    read = -(-visible_at[real][at] // last) * last
    return distribution((read[1:] + last - arrived[:-1] - first) * tick_ms)
