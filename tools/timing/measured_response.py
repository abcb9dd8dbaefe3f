"""The response of the whole system, measured and compared with its bounds (eqs 3.2 and 3.3).

Every message carries the tick of the oldest information on which it depends. A command can
therefore be followed from the release of the highest level to the cycle of the lowest level that
acts on it, and a status back up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.boards.config import build_rack_timing
from rack.boards.timing.chains import ParallelChains
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.system_response import find_path_mailboxes
from rack.boards.timing.trace_times import compute_distribution, count_misses_and_skips
from rack.boards.timing.verdicts import name_response_subject
from rack.tools.console.answer import Document
from rack.tools.monitor.network import read_entries
from rack.tools.recording.recording import Recording

LOSS_CODES = ("died", "hang")
"""Event codes of a lost board."""


def measure_system_response(recording: Recording) -> Document | None:
    """Return the response of commands downward and of statuses upward, in ticks and ms.

    The main figures belong to the chains with the longest response; `others` contains the same
    figures for all other chains. `beyond` lists the responses that exceed their bound, with the
    causes of delay that the run shows. `unseen` counts responses that cannot be measured because
    the recording lacks messages. `crosses_racks` is true if the rack imports messages of others,
    which the bounds do not cover.

    Returns:
        The response as plain data. None without a hierarchy.
    """
    rack = build_rack_timing(recording.rack_config, recording.layout)
    first = rack.hierarchy
    if not first.chains:
        return None
    imported = read_entries(recording.config)
    return {
        **_measure_response(recording, rack, first),
        "crosses_racks": imported is not None and bool(imported.imports),
        "others": [
            _measure_response(recording, rack, chains)
            for chains in rack.chain_groups
            if chains != first
        ],
    }


def _measure_response(recording: Recording, rack: RackTiming, chains: ParallelChains) -> Document:
    """Return the response along parallel chains in both directions as plain data."""
    tick_ms = rack.clock_ns * 1e-6
    return {
        "subject": name_response_subject(rack, chains),
        "levels": list(chains.levels),
        "bound_eq_3_2_ms": chains.bound * tick_ms,
        "sum_eq_3_3_ms": sum(chains.cycles) * tick_ms,
        "command": _measure_direction(recording, rack, chains.chains, chains.levels),
        "status": _measure_direction(
            recording, rack, [boards[::-1] for boards in chains.chains], chains.levels[::-1]
        ),
    }


def _measure_direction(
    recording: Recording, rack: RackTiming, chains: Sequence[Sequence[str]], levels: Sequence[str]
) -> Document:
    """Compare the responses along chains with their bound.

    A response lasts from the first board's release to the last board's cycle.

    Args:
        recording: Recording of the run.
        rack: Timing of the rack.
        chains: Boards of each chain, in the direction of the information.
        levels: Levels of the chains. The measurement restarts after a level that does not pass the
            information on.
    """
    layout = recording.layout
    paths = [(boards, find_path_mailboxes(layout, boards)) for boards in chains]
    hop_count = min(len(mailboxes) for _, mailboxes in paths)
    start = len(levels) - hop_count - 1 if hop_count else len(levels)
    bound_ms = (
        max(rack.compute_response_ticks(boards[start:]) for boards in chains)
        * layout.clock_ns
        * 1e-6
    )
    measurements = [
        _measure_chain(recording, boards[start:], boxes[-hop_count:], bound_ms)
        for boards, boxes in paths
        if hop_count and {box.name for box in boxes} <= set(recording.mailboxes)
    ]
    responses_ms = np.concatenate([np.zeros(0), *(ms for ms, _, _ in measurements)])
    beyond = [each for _, late, _ in measurements for each in late]
    return {
        "levels": list(levels[start:]),
        "measured_ms": compute_distribution(responses_ms),
        "bound_ms": bound_ms,
        "holds": not beyond if len(responses_ms) else None,
        "beyond": beyond,
        "unseen": sum(unseen for _, _, unseen in measurements),
    }


def _measure_chain(
    recording: Recording, boards: Sequence[str], boxes: Sequence[MailboxSpec], bound_ms: float
) -> tuple[np.ndarray, list[Document], int]:
    """Measure the responses along one chain.

    The worst case is information that arrives just after a release whose message passed the whole
    chain. It has to wait for the next such release.

    Args:
        recording: Recording of the run.
        boards: Boards of the chain.
        boxes: Mailboxes between them.
        bound_ms: Bound of the response, ms.

    Returns:
        The responses in ms, those beyond the bound, and the number that could not be measured.
    """
    layout = recording.layout
    mailbox = boxes[-1].name
    first, last = (layout.find_task(boards[at]).every for at in (0, -1))
    tick_ms = layout.clock_ns * 1e-6
    basis = recording.read_signal(mailbox, "basis")
    visible_at = recording.read_signal(mailbox, "visible_at")
    # The first messages depend only on their own ticks, because no information had arrived when
    # they were written. They do not count.
    first_basis = max(int(recording.read_signal(box.name, "visible_at")[0]) for box in boxes)
    valid_rows = np.flatnonzero(basis >= first_basis)
    arrived, at = np.unique(basis[valid_rows], return_index=True)
    at = valid_rows[at]
    visible = visible_at[at[1:]]
    read = layout.find_read_grid(boxes[-1], boards[-1])
    acts = visible + (read.phase - visible) % read.every + last
    ms = (acts - arrived[:-1] - first) * tick_ms
    is_seen = np.ones(len(ms), bool)
    if recording.lost_rows.get(mailbox) or recording.kept:
        # The first message with the information may be among the unrecorded ones.
        gaps = np.cumsum(np.diff(recording.read_signal(mailbox, "serial"), prepend=0) > 1)
        is_seen = gaps[at[1:]] == gaps[at[:-1]]
    beyond = [
        {
            "tick": int(arrived[k]),
            "ms": round(float(ms[k]), 6),
            "delayed_by": list(_list_delays(recording, boards, int(arrived[k]), int(acts[k]))),
        }
        for k in np.flatnonzero(is_seen & (ms > bound_ms + tick_ms / 2))
    ]
    return ms[is_seen], beyond, int(np.count_nonzero(~is_seen))


def _list_delays(
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
