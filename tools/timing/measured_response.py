"""The response of the whole system, measured and compared with its bounds (eqs 3.2 and 3.3).

Every message carries the tick of the oldest information on which it depends. A command can
therefore be followed from the release of the highest level to the cycle of the lowest level that
acts on it, and a status back up.

Along boards of several racks, a response is measured as far as one run of the last rack shows it.
The status of the network adapter records when the information of each imported message arrived at
the first board of the other rack, in ticks of this rack. In real time that tick is early by at most
the uncertainty of the clock comparison, so no response is measured too short.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rack.boards.config import build_rack_timing
from rack.boards.timing.chains import ParallelChains
from rack.boards.timing.joined import JoinedPath, format_joined_levels
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.system_response import find_path_mailboxes
from rack.boards.timing.verdicts import SYSTEM, name_response_subject
from rack.tools.console.answer import Document
from rack.tools.monitor.network import ADAPTER, STATUS, read_entries
from rack.tools.recording.joined import read_joined_paths
from rack.tools.recording.recording import Recording
from rack.tools.timing.chain_response import NOT_MEASURED, BoardChain, Origins, measure_direction

LOSSES = {
    "missing": "were lost before it",
    "late": "were older than max_age_ms before it",
    "superseded": "were overtaken on the way",
}
"""Counts of an import whose messages did not get through, and how they got lost."""


class ImportedMessages(NamedTuple):
    """Imported messages on a path across racks, in ascending order of `basis`.

    Times are in ticks of the importing rack, and in fractions of them.

    Attributes:
        basis: When they were written, as this rack knew it.
        taken: When this rack took them.
        serials: Their serials in the exported mailbox.
        lost: Number of messages that did not get through since the one before, by `LOSSES`,
            shape (n, 3).
        written: When they were written.
        arrived: When their oldest information arrived at the first board.
        gaps: Number of messages before each that are left out because nothing is known of them.
        parts: Known parts of the time from `arrived` to `written`, ms, by rack and link.
        uncertainty_ms: Largest error of `arrived`, or 0 if it is never late.
        list_delays: Yields a text for each cause of delay in other racks between two messages,
            given by their indices.
    """

    basis: np.ndarray
    taken: np.ndarray
    serials: np.ndarray
    lost: np.ndarray
    written: np.ndarray
    arrived: np.ndarray
    gaps: np.ndarray
    parts: Mapping[str, np.ndarray] = {}
    uncertainty_ms: float = 0.0
    list_delays: Callable[[int, int], Iterator[str]] = lambda _previous, _at: iter(())

    def select_messages(self, which: np.ndarray) -> ImportedMessages:
        """Return the messages for which `which` is True, as this rack knew them."""
        gaps = self.gaps + np.cumsum(~which)
        return ImportedMessages(*(column[which] for column in (*self[:6], gaps)))


Refinement = Callable[[Recording, JoinedPath, ImportedMessages], ImportedMessages]
"""Completes the messages that a recording shows on a path."""


def measure_system_response(recording: Recording) -> Document | None:
    """Return the response of commands downward and of statuses upward, in ticks and ms.

    The main figures belong to the chains with the longest response; `others` contains the same
    figures for all other chains. `beyond` lists the responses that exceed their bound, with the
    causes of delay that the run shows. `unseen` counts responses that cannot be measured because
    the recording lacks messages. A direction whose information comes from another rack has no
    levels among the chains of this rack. Instead, `others` contains a chain across the racks.
    `crosses_racks` is true if such chains are missing, because the run does not know the timing of
    other racks.

    Returns:
        The response as plain data. None without a hierarchy.
    """
    rack = build_rack_timing(recording.rack_config, recording.layout)
    paths = read_joined_paths(recording)
    documents = [
        _measure_response(recording, rack, chains)
        for chains in sorted(rack.chain_groups, key=lambda chains: chains != rack.hierarchy)
    ]
    documents += measure_joined_responses(recording, paths or ())
    if not documents:
        return None
    # Without measurements, a response needs no place beside others.
    measured = [one for one in documents if one["command"]["levels"] or one["status"]["levels"]]
    first, *others = measured or documents[:1]
    crosses_racks = not paths and bool(read_entries(recording.config).imports)
    return {**first, "crosses_racks": crosses_racks, "others": others}


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
    # Paths that end in the same mailbox have the same messages.
    paths = [
        (boards, row)
        for boards in chains
        for row in {row[-1:]: row for row in find_path_mailboxes(layout, boards)}.values()
    ]
    imported = {f"{ADAPTER}.{port}" for port in read_entries(recording.config).imports}
    if any(boxes and not imported.isdisjoint(boxes[0].rests_on) for _, boxes in paths):
        return NOT_MEASURED
    hop_count = min(len(mailboxes) for _, mailboxes in paths)
    start = len(levels) - hop_count - 1 if hop_count else len(levels)
    bound_ms = (
        max(rack.compute_response_ticks(boards[start:]) for boards in chains)
        * layout.clock_ns
        * 1e-6
    )
    measured = [
        BoardChain(boards[start:], boxes[-hop_count:]) for boards, boxes in paths if hop_count
    ]
    return measure_direction(recording, levels[start:], bound_ms, measured)


def measure_joined_responses(
    recording: Recording, paths: Sequence[JoinedPath], refine: Refinement | None = None
) -> Iterator[Document]:
    """Yield the response along each group of parallel paths from another rack as plain data.

    Parallel paths, such as those through one board per joint, have equal bounds and lead through
    boards of the same levels. An entry has the form of the response along the chains of one rack,
    with only one direction. Paths are left out if their messages do not carry the origin of the
    information to the last board.

    Args:
        recording: Recording of the last rack.
        paths: The paths.
        refine: As for `find_origins`.
    """
    groups: dict[object, list[JoinedPath]] = {}
    for path in paths:
        ends = path.stations[0], path.stations[-1]
        key = path.direction, path.port, ends, len(path.stations), path.response_ms
        groups.setdefault(key, []).append(path)
    for group in groups.values():
        rows = [
            (each, row)
            for each in group
            for row in find_path_mailboxes(recording.layout, (ADAPTER, *each.boards))
        ]
        chains = [
            BoardChain((ADAPTER, *each.boards), row, find_origins(recording, each, refine))
            for each, row in rows
            if len(row) == len(each.boards)
            and row[0].name == f"{ADAPTER}.{each.port}"
            and {STATUS, *(box.name for box in row)} <= {*recording.mailboxes}
        ]
        if not chains and refine is None:
            continue
        path = group[0]
        levels = [*format_joined_levels([each.stations for each in group])]
        measured = measure_direction(recording, levels, path.response_ms, chains)
        directions = {"command": NOT_MEASURED, "status": NOT_MEASURED, path.direction: measured}
        downward = levels if path.direction == "command" else levels[::-1]
        yield {
            "subject": f"{SYSTEM}, {' > '.join(downward)}",
            "levels": downward,
            "bound_eq_3_2_ms": path.bound_eq_3_2_ms,
            "sum_eq_3_3_ms": path.sum_eq_3_3_ms,
            **directions,
        }


def find_origins(recording: Recording, path: JoinedPath, refine: Refinement | None) -> Origins:
    """Return when the information in the imported messages of a path arrived at its first board.

    Args:
        recording: Recording of the last rack.
        path: The path.
        refine: Completes what this recording shows by what others show.
    """
    entry = f"import_{path.port}"
    ticks, ages, origin_s, serials, *counts = (
        recording.read_signal(STATUS, field)
        for field in (
            "tick",
            *(f"{entry}.{name}" for name in ("age", "origin_s", "serial", *LOSSES)),
        )
    )
    basis = np.maximum(ticks - ages, 0)
    # The first status with a message belongs to the cycle that took it over.
    rows = np.flatnonzero((ages >= 0) & (np.diff(basis, prepend=-1) != 0))
    rows = rows[np.argsort(basis[rows], kind="stable")]
    tick_ms = recording.layout.clock_ns * 1e-6
    messages = ImportedMessages(
        basis=basis[rows],
        taken=ticks[rows],
        serials=serials[rows],
        lost=np.diff(np.stack(counts, 1)[rows], axis=0, prepend=0),
        written=basis[rows],
        arrived=origin_s[rows] * 1e3 / tick_ms,
        gaps=np.zeros(len(rows), int),
    )
    # Without the other recordings, times of messages are whole ticks.
    rounding_ms = tick_ms
    if refine is not None:
        rounding_ms = 0.0
        messages = refine(recording, path, messages)
    rack, board = path.stations[-1 - len(path.boards)]
    all_far_ms = (messages.written - messages.arrived) * tick_ms
    all_link_ms = (messages.taken - messages.written) * tick_ms

    def list_delays(earlier: float, tick: float) -> Iterator[str]:
        """Yield a text for each cause of delay before the message with this origin was taken."""
        previous, at = (int(np.flatnonzero(messages.arrived == one)[0]) for one in (earlier, tick))
        gap_ms = (tick - messages.arrived[at - 1]) * tick_ms
        far_ms, link_ms = all_far_ms[at], all_link_ms[at]
        if far_ms > path.far_ms + rounding_ms:
            yield (
                f"in rack '{rack}' it took {far_ms:g} ms until '{board}' wrote;"
                f" bound {path.far_ms:g} ms"
            )
        if link_ms > path.link_ms + rounding_ms:
            yield (
                f"the link took {link_ms:g} ms from '{rack}/{board}'; bound {path.link_ms:g} ms"
                f" with adapter.lan.import.{path.port}.delay_ms"
            )
        for count, (_, text) in zip(messages.lost[at], LOSSES.items(), strict=True):
            if count:
                yield f"{count} messages of '{rack}/{board}' {text}"
        if gap_ms > path.exchange_ms + rounding_ms and not messages.lost[at].any():
            yield (
                f"'{rack}/{board}' sent nothing new for {gap_ms:g} ms; it should every"
                f" {path.exchange_ms:g} ms"
            )
        yield from messages.list_delays(previous, at)

    return Origins(
        messages.basis,
        messages.arrived,
        path.first_cycle_ms / tick_ms,
        list_delays,
        {
            **messages.parts,
            rack: all_far_ms - sum(messages.parts.values()),
            f"link to {path.stations[-1][0]}": all_link_ms,
        },
        messages.uncertainty_ms,
        messages.gaps,
    )
