"""The response of the whole system, measured and compared with its bounds (eqs 3.2 and 3.3).

Every message carries the tick of the oldest information that it rests on. A command can therefore
be followed from the release of the highest level to the cycle of the lowest level that acts on it,
and a status back up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.boards.config import rack_timing
from rack.boards.timing.chains import ParallelChains
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.system_response import mailboxes_along
from rack.boards.timing.trace_times import counts, distribution
from rack.boards.timing.verdicts import response_subject
from rack.tools.console.answer import Document
from rack.tools.monitor.network import exchanged
from rack.tools.recording.recording import Recording

LOSSES = ("died", "hang")
"""Codes of the events of a lost board."""


def system_response(recording: Recording) -> Document | None:
    """Return the response down (commands) and up (statuses), in ticks and ms; None without a
    hierarchy.

    It is that of the chains with the longest response; `others` holds the same for all other chains
    of the rack. `beyond` are the responses longer than their bound, each with the delays that the
    run shows; `unseen` counts those that cannot be measured because the recording lacks messages.
    `crosses_racks`: the rack imports messages of others, of which the bounds know nothing.
    """
    rack = rack_timing(recording.rack_config, recording.layout)
    first = rack.hierarchy
    if not first.chains:
        return None
    imported = exchanged(recording.config)
    return {
        **_response(recording, rack, first),
        "crosses_racks": imported is not None and bool(imported.imports),
        "others": [
            _response(recording, rack, chains) for chains in rack.parallel if chains != first
        ],
    }


def _response(recording: Recording, rack: RackTiming, chains: ParallelChains) -> Document:
    tick_ms = rack.clock_ns * 1e-6
    return {
        "subject": response_subject(rack, chains),
        "levels": list(chains.levels),
        "bound_eq_3_2_ms": chains.bound * tick_ms,
        "sum_eq_3_3_ms": sum(chains.cycles) * tick_ms,
        "command": _way(recording, rack, chains.chains, chains.levels),
        "status": _way(
            recording, rack, [boards[::-1] for boards in chains.chains], chains.levels[::-1]
        ),
    }


def _way(
    recording: Recording, rack: RackTiming, chains: Sequence[Sequence[str]], levels: Sequence[str]
) -> Document:
    """Judge the response along all of these chains, from their first board's release to the last
    one's cycle.

    `levels` are those over which it is measured: after a level that does not pass the information
    on, it begins anew.
    """
    layout = recording.layout
    ways = [(boards, mailboxes_along(layout, boards)) for boards in chains]
    passed = min(len(mailboxes) for _, mailboxes in ways)
    start = len(levels) - passed - 1 if passed else len(levels)
    bound_ms = (
        max(rack.response_ticks(boards[start:]) for boards in chains) * layout.clock_ns * 1e-6
    )
    found = [
        _along(recording, boards[start:], boxes[-passed:], bound_ms)
        for boards, boxes in ways
        if passed and {box.name for box in boxes} <= set(recording.mailboxes)
    ]
    seen = np.concatenate([np.zeros(0), *(ms for ms, _, _ in found)])
    beyond = [each for _, late, _ in found for each in late]
    return {
        "levels": list(levels[start:]),
        "measured_ms": distribution(seen),
        "bound_ms": bound_ms,
        "holds": not beyond if len(seen) else None,
        "beyond": beyond,
        "unseen": sum(unseen for _, _, unseen in found),
    }


def _along(
    recording: Recording, boards: Sequence[str], boxes: Sequence[MailboxSpec], bound_ms: float
) -> tuple[np.ndarray, list[Document], int]:
    """Return the responses along one chain by its mailboxes, ms, those beyond the bound, and the
    number unseen.

    The worst case is information that just misses a release whose message went all the way: it
    waits for the next one that does.
    """
    layout = recording.layout
    mailbox = boxes[-1].name
    first, last = (layout.task(boards[at]).every for at in (0, -1))
    tick_ms = layout.clock_ns * 1e-6
    basis = recording.signal(mailbox, "basis")
    visible_at = recording.signal(mailbox, "visible_at")
    # A message that nothing had reached when it was written rests on its own tick: before all that
    # counts here.
    begun = max(int(recording.signal(box.name, "visible_at")[0]) for box in boxes)
    real = np.flatnonzero(basis >= begun)
    arrived, at = np.unique(basis[real], return_index=True)
    at = real[at]
    visible = visible_at[at[1:]]
    read = layout.read_grid(boxes[-1], boards[-1])
    acts = visible + (read.phase - visible) % read.every + last
    ms = (acts - arrived[:-1] - first) * tick_ms
    seen = np.ones(len(ms), bool)
    if recording.lost.get(mailbox) or recording.kept:
        # The first message with the information may be among those that are not recorded.
        gaps = np.cumsum(np.diff(recording.signal(mailbox, "serial"), prepend=0) > 1)
        seen = gaps[at[1:]] == gaps[at[:-1]]
    beyond = [
        {
            "tick": int(arrived[k]),
            "ms": round(float(ms[k]), 6),
            "delayed_by": list(_delays(recording, boards, int(arrived[k]), int(acts[k]))),
        }
        for k in np.flatnonzero(seen & (ms > bound_ms + tick_ms / 2))
    ]
    return ms[seen], beyond, int(np.count_nonzero(~seen))


def _delays(recording: Recording, levels: Sequence[str], since: int, until: int) -> Iterator[str]:
    """Yield the faults, losses and misses between two ticks of the levels that the information
    passes.
    """
    for fault in recording.ended.get("faults", ()):
        if 0 <= fault["began"] < until and not 0 <= fault["ends"] <= since:
            yield f"fault: {fault['kind']} of {fault['board']}"
    lost = [
        e["subject"] or e["board"]
        for e in recording.events
        if e.get("code") in LOSSES and since <= e["tick"] < until
    ]
    yield from (f"{board} was lost" for board in dict.fromkeys(lost))
    for name in levels:
        rows = recording.trace(name)
        last = until + recording.layout.task(name).every
        missed, skipped = counts(rows[(rows["tick"] >= since) & (rows["tick"] < last)])
        if missed or skipped:
            yield f"{name}: {missed} missed, {skipped} skipped"
