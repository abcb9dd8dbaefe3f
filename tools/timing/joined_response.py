"""Measured response along boards of several racks, as far as one run of the last rack shows it.

The status of the network adapter records when the information of each imported message arrived at
the first board of the other rack, in ticks of this rack. In real time that tick is early by at most
the uncertainty of the clock comparison, so no response is measured too short.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from rack.boards.config.schema import LAN
from rack.boards.timing.joined import JoinedPath, format_joined_levels
from rack.boards.timing.system_response import find_path_mailboxes
from rack.boards.timing.verdicts import SYSTEM
from rack.tools.console.answer import Document
from rack.tools.monitor.network import STATUS
from rack.tools.recording.recording import Recording
from rack.tools.timing.chain_response import NOT_MEASURED, Chain, Origins, measure_direction


def measure_joined_responses(
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
        boxes = [find_path_mailboxes(recording.layout, (LAN, *each.boards)) for each in group]
        chains = [
            Chain((LAN, *each.boards), row, find_origins(recording, each))
            for each, row in zip(group, boxes, strict=True)
            if len(row) == len(each.boards)
            and row[0].name == f"{LAN}.{each.port}"
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


def find_origins(recording: Recording, path: JoinedPath) -> Origins:
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
