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

from collections.abc import Iterator, Sequence

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
    imported = read_entries(recording.config)
    documents = [
        _measure_response(recording, rack, chains)
        for chains in sorted(rack.chain_groups, key=lambda chains: chains != rack.hierarchy)
    ]
    documents += _measure_joined_responses(recording, paths or ())
    if not documents:
        return None
    # Without measurements, a response needs no place beside others.
    measured = [one for one in documents if one["command"]["levels"] or one["status"]["levels"]]
    first, *others = measured or documents[:1]
    crosses_racks = not paths and imported is not None and bool(imported.imports)
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
    paths = [(boards, find_path_mailboxes(layout, boards)) for boards in chains]
    entries = read_entries(recording.config)
    imported = {f"{ADAPTER}.{port}" for port in entries.imports} if entries else set[str]()
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


def _measure_joined_responses(
    recording: Recording, paths: Sequence[JoinedPath]
) -> Iterator[Document]:
    """Yield the response along each group of parallel paths from another rack as plain data.

    Parallel paths, such as those through one board per joint, have equal bounds and lead through
    boards of the same levels. An entry has the form of the response along the chains of one rack,
    with only one direction. Paths are left out if their messages do not carry the origin of the
    information to the last board.
    """
    groups: dict[object, list[JoinedPath]] = {}
    for path in paths:
        ends = path.stations[0], path.stations[-1]
        key = path.direction, path.port, ends, len(path.stations), path.response_ms
        groups.setdefault(key, []).append(path)
    for group in groups.values():
        boxes = [find_path_mailboxes(recording.layout, (ADAPTER, *each.boards)) for each in group]
        chains = [
            BoardChain((ADAPTER, *each.boards), row, _find_origins(recording, each))
            for each, row in zip(group, boxes, strict=True)
            if len(row) == len(each.boards)
            and row[0].name == f"{ADAPTER}.{each.port}"
            and {STATUS, *(box.name for box in row)} <= {*recording.mailboxes}
        ]
        if not chains:
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


def _find_origins(recording: Recording, path: JoinedPath) -> Origins:
    """Return when the information in the imported messages of a path arrived at its first board."""
    entry = f"import_{path.port}"
    ticks, ages, origin_s, lost = (
        recording.read_signal(STATUS, field)
        for field in ("tick", f"{entry}.age", f"{entry}.origin_s", f"{entry}.missing")
    )
    basis = np.maximum(ticks - ages, 0)
    # The first status with a message belongs to the cycle that took it over.
    taken = np.flatnonzero((ages >= 0) & (np.diff(basis, prepend=-1) != 0))
    tick_ms = recording.layout.clock_ns * 1e-6
    arrived = origin_s * 1e3 / tick_ms
    rack, board = path.stations[-1 - len(path.boards)]

    def list_delays(earlier: float, tick: float) -> Iterator[str]:
        """Yield a text for each cause of delay before the message with this origin was taken."""
        row = taken[np.flatnonzero(arrived[taken] == tick)[0]]
        gap_ms = (tick - earlier) * tick_ms
        far_ms = (basis[row] - arrived[row]) * tick_ms
        link_ms = (ticks[row] - basis[row]) * tick_ms
        if far_ms > path.far_ms + tick_ms:
            yield (
                f"in rack '{rack}' it took {far_ms:g} ms until '{board}' wrote;"
                f" bound {path.far_ms:g} ms"
            )
        if link_ms > path.link_ms + tick_ms:
            yield (
                f"the link took {link_ms:g} ms from '{rack}/{board}'; bound {path.link_ms:g} ms"
                f" with adapter.lan.import.{path.port}.delay_ms"
            )
        if missing := int(lost[row] - lost[max(row - 1, 0)]):
            yield f"{missing} messages of '{rack}/{board}' were lost before it"
        elif gap_ms > path.exchange_ms + tick_ms:
            yield (
                f"'{rack}/{board}' sent nothing new for {gap_ms:g} ms; it should every"
                f" {path.exchange_ms:g} ms"
            )

    order = taken[np.argsort(basis[taken], kind="stable")]
    return Origins(basis[order], arrived[order], path.first_cycle_ms / tick_ms, list_delays)
