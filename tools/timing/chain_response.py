"""Measured response along one chain of boards, and the causes of long responses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.boards.timing.trace_times import compute_distribution, count_misses_and_skips
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Recording

LOSS_CODES = ("died", "hang")
"""Event codes of a lost board."""


class Origins(NamedTuple):
    """When the information in the messages of a chain arrived at the first board of another rack.

    Attributes:
        basis: Ticks at which the other rack wrote its messages, in ascending order.
        arrived: When the information in each of these messages arrived there, in ticks of this rack
            and fractions of them.
        first_ticks: Cycle of that board in ticks of this rack.
        list_delays: Yields a text for each cause of delay on the way to this rack. Its arguments
            are two successive values of `arrived`; the response ends with the message of the
            second.
        parts: Times in ms on the way to this rack, for each message, by rack and link.
        uncertainty_ms: Largest error of `arrived`, or 0 if it is never late.
        gaps: Number of messages before each whose origin is not recorded.
    """

    basis: np.ndarray
    arrived: np.ndarray
    first_ticks: float
    list_delays: Callable[[float, float], Iterator[str]]
    parts: Mapping[str, np.ndarray]
    uncertainty_ms: float
    gaps: np.ndarray


class BoardChain(NamedTuple):
    """A chain of boards.

    Attributes:
        boards: The boards.
        boxes: Mailboxes between them.
        origins: Origins of the information, if it comes from another rack.
    """

    boards: Sequence[str]
    boxes: Sequence[MailboxSpec]
    origins: Origins | None = None


class ChainResponses(NamedTuple):
    """Responses along one chain.

    Attributes:
        times_ms: The responses, shape (n,).
        beyond: Entries for those that exceed the bound.
        unseen: Number of responses that could not be measured.
        parts: Times of the longest response in ms, by rack and link. Empty within one rack.
        uncertainty_ms: Largest error of the responses.
    """

    times_ms: np.ndarray
    beyond: list[Document]
    unseen: int
    parts: dict[str, float]
    uncertainty_ms: float


def measure_direction(
    recording: Recording, levels: Sequence[str], bound_ms: float, chains: Iterable[BoardChain]
) -> Document:
    """Return the responses along parallel chains in one direction as plain data.

    Args:
        recording: Recording of the run.
        levels: Boards of each level as text.
        bound_ms: Bound of the response, ms.
        chains: The chains. Those with a mailbox that was not recorded are left out.
    """
    recorded = {*recording.mailboxes}
    measured = [
        _measure_chain(recording, chain, bound_ms)
        for chain in chains
        if recorded.issuperset(box.name for box in chain.boxes)
    ]
    responses_ms = np.concatenate([np.zeros(0), *(each.times_ms for each in measured)])
    beyond = [excess for each in measured for excess in each.beyond]
    longest = max(measured, key=lambda each: each.times_ms.max(initial=0.0), default=None)
    return {
        "levels": list(levels),
        "measured_ms": compute_distribution(responses_ms),
        "bound_ms": bound_ms,
        "holds": not beyond if len(responses_ms) else None,
        "beyond": beyond,
        "unseen": sum(each.unseen for each in measured),
        "count": len(longest.times_ms) if longest else 0,
        "uncertainty_ms": longest.uncertainty_ms if longest else 0.0,
        "parts": longest.parts if longest else {},
    }


def _measure_chain(recording: Recording, chain: BoardChain, bound_ms: float) -> ChainResponses:
    """Measure the responses along one chain.

    The worst case is information that arrives just after a release whose message passed the whole
    chain. It has to wait for the next such release.
    """
    boards, boxes, origins = chain
    layout = recording.layout
    mailbox = boxes[-1].name
    first: float = layout.find_task(boards[0]).every
    last = layout.find_task(boards[-1]).every
    tick_ms = layout.clock_ns * 1e-6
    basis = recording.read_signal(mailbox, "basis")
    visible_at = recording.read_signal(mailbox, "visible_at")
    # The first messages depend only on their own ticks, because no information had arrived when
    # they were written. They do not count.
    first_basis = max(int(recording.read_signal(box.name, "visible_at")[0]) for box in boxes)
    valid_rows = np.flatnonzero(basis >= first_basis)
    arrived, at = np.unique(basis[valid_rows], return_index=True)
    at = valid_rows[at]
    if origins is not None:
        # Without the status of the adapter, the origin of a message is unknown.
        is_known = np.isin(arrived, origins.basis)
        arrived, at = arrived[is_known], at[is_known]
        messages = np.searchsorted(origins.basis, arrived)
        arrived = origins.arrived[messages]
        first = origins.first_ticks
    visible = visible_at[at[1:]]
    read = layout.find_read_grid(boxes[-1], boards[-1])
    acts = visible + (read.phase - visible) % read.every + last
    ms = (acts - arrived[:-1] - first) * tick_ms
    is_seen = np.ones(len(ms), bool)
    if recording.lost_rows.get(mailbox) or recording.kept:
        # The first message with the information may be among the unrecorded ones.
        gaps = np.cumsum(np.diff(recording.read_signal(mailbox, "serial"), prepend=0) > 1)
        is_seen = gaps[at[1:]] == gaps[at[:-1]]
    uncertainty_ms = origins.uncertainty_ms if origins else 0.0
    parts: dict[str, float] = {}
    if origins is not None:
        is_seen &= np.diff(origins.gaps[messages]) == 0
        if is_seen.any():
            longest = int((ms * is_seen).argmax())
            wait = arrived[longest + 1] - arrived[longest] - first
            parts = {name: times[messages[longest + 1]] for name, times in origins.parts.items()}
            parts = {"waiting for new information": wait * tick_ms, **parts}
            parts[layout.rack] = ms[longest] - sum(parts.values())
            parts = {name: round(float(part_ms), 6) for name, part_ms in parts.items()}
    beyond = [
        {
            "tick": int(arrived[k]),
            "ms": round(float(ms[k]), 6),
            "delayed_by": [*list_delays(recording, boards, int(arrived[k]), int(acts[k]))],
            "network": [] if origins is None else [*origins.list_delays(*arrived[k : k + 2])],
        }
        for k in np.flatnonzero(is_seen & (ms > bound_ms + tick_ms / 2))
    ]
    unseen = int(np.count_nonzero(~is_seen))
    return ChainResponses(ms[is_seen], beyond, unseen, parts, uncertainty_ms)


def list_delays(
    recording: Recording, levels: Sequence[str], since: int, until: int
) -> Iterator[str]:
    """Yield a text for each cause of delay between two ticks.

    The causes are faults, lost boards, and boards with late cycles.

    Args:
        recording: Recording of the run.
        levels: Boards that the information passes.
        since: First tick.
        until: Tick after the last.
    """
    for fault in recording.end_counts.get("faults", ()):
        if 0 <= fault["began"] < until and not 0 <= fault["ends"] <= since:
            yield f"fault: {fault['kind']} of {fault['board']}"
    lost = [
        e["subject"] or e["board"]
        for e in recording.events
        if e.get("code") in LOSS_CODES and since <= e["tick"] < until
    ]
    yield from (f"{board} was lost" for board in dict.fromkeys(lost))
    for name in levels:
        rows = recording.read_trace(name)
        last_tick = until + recording.layout.find_task(name).every
        missed, skipped = count_misses_and_skips(
            rows[(rows["tick"] >= since) & (rows["tick"] < last_tick)]
        )
        if missed or skipped:
            yield f"{name}: {missed} missed, {skipped} skipped"


NOT_MEASURED: Document = {
    "levels": [],
    "measured_ms": None,
    "bound_ms": None,
    "holds": None,
    "beyond": [],
    "unseen": 0,
    "count": 0,
    "uncertainty_ms": 0.0,
    "parts": {},
}
"""Response in a direction that is not measured along these boards."""
