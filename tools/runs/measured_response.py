"""The response of the whole system, measured and compared with its bounds (eqs 3.2 and 3.3).

Every message carries the tick of the oldest information that it rests on. A command can therefore be followed from
the release of the highest level to the cycle of the lowest level that acts on it, and a status back up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rack.boards.config import rack_timing
from rack.levels.timing.system_response import predict
from rack.levels.timing.trace_times import counts, distribution
from rack.tools.runs.recording import Recording

LOSSES = ("died", "hang")
"""Codes of the events of a lost board."""


def system_response(recording: Recording) -> dict[str, Any] | None:
    """Return the response down (commands) and up (statuses), in ticks and ms; None without a hierarchy.

    `beyond` are the responses longer than their bound, each with the delays that the run shows; `unseen`
    counts those that cannot be measured because the recording lacks messages.
    """
    predicted = predict(rack_timing(recording.rack_config, recording.layout))
    levels = list(predicted.levels)
    if len(levels) < 2:
        return None
    return {
        "levels": levels,
        "bound_eq_3_2_ms": predicted.bound_eq_3_2_ms,
        "sum_eq_3_3_ms": predicted.sum_eq_3_3_ms,
        "command": _way(recording, levels, "command", predicted.command_ms),
        "status": _way(recording, levels[::-1], "status", predicted.status_ms),
    }


def _way(recording: Recording, levels: Sequence[str], port: str, bound_ms: float) -> dict[str, Any]:
    """Judge the response along `levels`, from the first one's release to the end of the last one's cycle.

    The worst case is information that just misses a release whose message went all the way: it waits for the next one
    that does.
    """
    layout = recording.layout
    first, last = (layout.task(levels[at]).every for at in (0, -1))
    mailbox, tick_ms = f"{levels[-2]}.{port}", layout.clock_ns * 1e-6
    read = layout.read_grid(layout.mailbox(mailbox), levels[-1])
    basis, visible_at = recording.signal(mailbox, "basis"), recording.signal(mailbox, "visible_at")
    # Until the first level's messages arrive, those of the later levels rest on their own ticks.
    real = np.flatnonzero(basis >= first + max(layout.task(name).phase for name in levels))
    arrived, at = np.unique(basis[real], return_index=True)
    at = real[at]
    visible = visible_at[at[1:]]
    acts = visible + (read.phase - visible) % read.every + last
    ms = (acts - arrived[:-1] - first) * tick_ms
    seen = np.ones(len(ms), bool)
    if recording.lost.get(mailbox):
        # The first message with the information may be among those that the recorder lost.
        gaps = np.cumsum(np.diff(recording.signal(mailbox, "serial"), prepend=0) > 1)
        seen = gaps[at[1:]] == gaps[at[:-1]]
    beyond = [
        {
            "tick": int(arrived[k]),
            "ms": round(float(ms[k]), 6),
            "delayed_by": list(_delays(recording, levels, int(arrived[k]), int(acts[k]))),
        }
        for k in np.flatnonzero(seen & (ms > bound_ms + tick_ms / 2))
    ]
    return {
        "measured_ms": distribution(ms[seen]),
        "bound_ms": bound_ms,
        "holds": not beyond if seen.any() else None,
        "beyond": beyond,
        "unseen": int(np.count_nonzero(~seen)),
    }


def _delays(recording: Recording, levels: Sequence[str], since: int, until: int) -> Iterator[str]:
    """Yield the faults, losses and misses between two ticks of the levels that the information passes."""
    for fault in recording.ended.get("faults", ()):
        if 0 <= fault["began"] < until and not 0 <= fault["ends"] <= since:
            yield f"fault: {fault['kind']} of {fault['board']}"
    lost = [
        e["subject"] or e["board"] for e in recording.events if e.get("code") in LOSSES and since <= e["tick"] < until
    ]
    yield from (f"{board} was lost" for board in dict.fromkeys(lost))
    for name in levels:
        rows, last = recording.trace(name), until + recording.layout.task(name).every
        missed, skipped = counts(rows[(rows["tick"] >= since) & (rows["tick"] < last)])
        if missed or skipped:
            yield f"{name}: {missed} missed, {skipped} skipped"
