"""The response of the whole system, measured and compared with its bounds (eqs 3.2 and 3.3).

Every message carries the tick of the oldest information on which it depends. A command can
therefore be followed from the release of the highest level to the cycle of the lowest level that
acts on it, and a status back up.
"""

from __future__ import annotations

from collections.abc import Sequence

from rack.boards.config import build_rack_timing
from rack.boards.timing.chains import ParallelChains
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.system_response import find_path_mailboxes
from rack.boards.timing.verdicts import name_response_subject
from rack.tools.console.answer import Document
from rack.tools.monitor.network import ADAPTER, read_entries
from rack.tools.recording.joined import read_joined_paths
from rack.tools.recording.recording import Recording
from rack.tools.timing.chain_response import NOT_MEASURED, Chain, measure_direction
from rack.tools.timing.joined_response import measure_joined_responses


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
    documents += measure_joined_responses(recording, paths or ())
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
    measured = [Chain(boards[start:], boxes[-hop_count:]) for boards, boxes in paths if hop_count]
    return measure_direction(recording, levels[start:], bound_ms, measured)
