"""Responses across racks, measured in the recordings of all racks that take part.

The status of an adapter contains the serial of each message that it imported, which finds the
message in the recording of the rack that wrote it. Its ticks are converted to the importing rack by
the recorded clock comparisons. A bound counts as held only if that is certain despite their
uncertainty.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from rack.boards.config.joined import join_racks
from rack.boards.timing.joined import JoinedPath
from rack.tools.console.answer import Document, Failure
from rack.tools.monitor.network import ADAPTER, read_entries
from rack.tools.recording.recording import Recording
from rack.tools.recording.time_line import align_racks
from rack.tools.timing.chain_response import list_delays
from rack.tools.timing.joined_check import judge_joined_racks
from rack.tools.timing.measured_response import (
    ImportedMessages,
    find_origins,
    measure_joined_responses,
)

MAX_CAUSES = 5
"""Largest number of different causes that the text lists for a path."""
ROUNDING_MS = 1e-6
MARKS = {True: "", False: "FAILS: ", None: "undecided: "}


def measure_joined_runs(recordings: Sequence[Recording]) -> list[Document]:
    """Return the responses along each group of parallel paths across racks as plain data.

    Raises:
        Failure: The racks did not run together, a rack between them is missing, or a link between
            them has no delay budget.
    """
    runs = {recording.layout.rack: recording for recording in recordings}
    if len(runs) < len(recordings):
        raise Failure(f"give one RUN of each rack; these are of {', '.join(runs)}", 2)
    layouts = {rack: recording.layout for rack, recording in runs.items()}
    joined = join_racks([each.rack_config for each in recordings], layouts)
    linked = {station.rack for chain in joined.chains for station in chain}
    for rack, recording in runs.items():
        if rack not in linked:
            peers = ", ".join(read_entries(recording.config).peers) or "no rack"
            raise Failure(
                f"{recording.folder}: no command passes between '{rack}' and the other racks given;"
                f" it exchanges messages with {peers}",
                2,
            )
    judge_joined_racks(joined)
    return [
        _describe_direction(way, document[way])
        for rack, recording in runs.items()
        for document in measure_joined_responses(
            recording, joined.list_paths(rack, is_whole=True), partial(_complete_messages, runs)
        )
        for way in ("command", "status")
        if document[way]["levels"]
    ]


def _describe_direction(direction: str, measured: Document) -> Document:
    """Return the responses in one direction with a verdict that allows for the uncertainty."""
    # Responses along parallel paths begin together. One of them stands for the others.
    beyond = {entry["tick"]: entry for entry in measured["beyond"]}
    within_ms = measured["bound_ms"] - measured["uncertainty_ms"]
    is_undecided = measured["holds"] and measured["measured_ms"]["max"] > within_ms + ROUNDING_MS
    return {
        "direction": direction,
        **measured,
        "holds": None if is_undecided else measured["holds"],
        "beyond": [*beyond.values()],
    }


def _complete_messages(
    runs: Mapping[str, Recording],
    recording: Recording,
    path: JoinedPath,
    messages: ImportedMessages,
) -> ImportedMessages:
    """Complete imported messages by what the recording of the rack that wrote them shows.

    Args:
        runs: Recordings of all racks by name.
        recording: Recording of the rack that imported the messages.
        path: Path on which they arrived.
        messages: The messages.

    Raises:
        Failure: The other rack wrote none of them, or other ones.
    """
    rack, _ = path.stations[-1 - len(path.boards)]
    other = runs[rack]
    place = align_racks([recording, other])[1]
    messages, sent = _match_messages(recording, path.port, messages, other)
    uncertainty_ns = place.uncertainty_ns * place.grid.clock_ns / place.grid.period_ns
    arrived = sent["basis"]
    parts: Mapping[str, np.ndarray] = {}
    origins = None
    if path.before is not None:
        origins = find_origins(other, path.before, partial(_complete_messages, runs))
        # The first messages depend on no message of the farther rack.
        is_known = np.isin(arrived, origins.basis)
        messages, sent = messages.select_messages(is_known), sent[is_known]
        at = np.searchsorted(origins.basis, sent["basis"])
        messages = messages._replace(gaps=messages.gaps + origins.gaps[at])
        arrived = origins.arrived[at]
        parts = {name: times_ms[at] for name, times_ms in origins.parts.items()}
        uncertainty_ns += origins.uncertainty_ms * 1e6

    def convert(ticks: np.ndarray) -> np.ndarray:
        """Convert ticks of the other rack to ticks of this rack."""
        times_ns = np.rint(ticks * other.layout.clock_ns).astype(np.int64)
        return place.convert_ticks(np.zeros_like(times_ns), times_ns) / recording.layout.clock_ns

    def list_far_delays(previous: int, at: int) -> Iterator[str]:
        """Yield a text for each cause of delay in other racks."""
        boards = [board for name, board in path.stations if name == rack]
        span = int(sent["basis"][previous]), int(sent["tick"][at]) + 1
        yield from (f"{rack}: {text}" for text in list_delays(other, [*boards, ADAPTER], *span))
        if origins is not None:
            yield from origins.list_delays(arrived[previous], arrived[at])

    return messages._replace(
        written=convert(sent["tick"]),
        arrived=convert(arrived),
        parts=parts,
        uncertainty_ms=uncertainty_ns * 1e-6,
        list_delays=list_far_delays,
    )


def _match_messages(
    recording: Recording, port: str, messages: ImportedMessages, other: Recording
) -> tuple[ImportedMessages, np.ndarray]:
    """Return imported messages that the other rack's recording contains, and their rows there.

    Raises:
        Failure: There are none, or they differ.
    """
    sent = other.read_rows(read_entries(recording.config).imports[port].partition("/")[2])
    got = recording.read_rows(f"{ADAPTER}.{port}")
    messages = messages.select_messages(np.isin(messages.serials, sent["serial"]))
    sent = sent[np.searchsorted(sent["serial"], messages.serials)]
    # A fault may keep a message that was taken from the mailbox.
    both = np.isin(messages.taken, got["tick"])
    pairs = sent[both], got[np.searchsorted(got["tick"], messages.taken[both])]
    first, second = (rows["message"] for rows in pairs)
    if not len(first) or any(
        first[name].tobytes() != second[name].tobytes() for name in first.dtype.names or ()
    ):
        raise Failure(
            f"{recording.folder} and {other.folder} are not of the same run: they have no message"
            f" of adapter.lan.import.{port} in common",
            2,
        )
    return messages, sent


def format_joined_runs(documents: Sequence[Document]) -> Iterator[str]:
    """Yield the verdict on the responses across racks, and lines for each group of paths."""
    verdicts = Counter(one["holds"] if one["count"] else "not measured" for one in documents)
    others = {False: "failed", None: "undecided", "not measured": "not measured"}
    held = f"across racks: {verdicts[True]} of {len(documents)} responses held their bounds"
    more = [f"{verdicts[key]} {word}" for key, word in others.items() if verdicts[key]]
    yield ", ".join([held, *more])
    for one in documents:
        levels = " > ".join(one["levels"])
        if not one["count"]:
            yield f"  not measured: {one['direction']} {levels}"
            continue
        within = f" +- {one['uncertainty_ms']:.2g}" * (one["uncertainty_ms"] > 0.0)
        yield (
            f"  {MARKS[one['holds']]}{one['direction']}: at most"
            f" {one['measured_ms']['max']:.4g}{within} ms, bound {one['bound_ms']:g} ms;"
            f" {one['count']} measured, {len(one['beyond'])} beyond"
        )
        yield f"    {levels}"
        parts = one["parts"]
        shares = ", ".join(f"{name} {ms:.4g}" for name, ms in parts.items())
        yield f"    longest in {max(parts, key=parts.__getitem__)}: {shares} ms"
        rack = one["levels"][-1].partition("/")[0]
        causes = Counter(
            cause
            for entry in one["beyond"]
            for cause in (*entry["network"], *(f"{rack}: {text}" for text in entry["delayed_by"]))
        )
        yield from (f"    {count}: {cause}" for cause, count in causes.most_common(MAX_CAUSES))
