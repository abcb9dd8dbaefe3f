"""Export of a recording to a trace for Perfetto.

Each task has a track in the group `boards`. A cycle is a slice that contains the slices `read`,
`process` and `write`. Instants are messages, missed cycles, skipped releases and events of the run.
An arrow leads from each message to the first cycle of another task that read it. The group `cores`
has the cycles on each core. Times are those of the wall clock, counted from the first cycle; in
lockstep a tick therefore takes as long as its cycles.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import (
    TracePacket,
    TrackDescriptor,
    TrackEvent,
)
from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder

from rack.backplane.layout import MailboxSpec
from rack.boards.timing.trace_times import count_skipped_releases, find_missed_cycles
from rack.tools.console.answer import Failure
from rack.tools.recording.recording import Recording

BEGIN = TrackEvent.TYPE_SLICE_BEGIN
END = TrackEvent.TYPE_SLICE_END
INSTANT = TrackEvent.TYPE_INSTANT


class PerfettoWriter:
    """Writes tracks and their events to a file.

    Attributes:
        count: Number of slices and instants so far.
    """

    def __init__(self, file: IO[bytes], origin_ns: int) -> None:
        self._builder = StreamingTraceProtoBuilder(file)
        self._origin_ns = origin_ns
        self._tracks = 0
        self.count = 0

    def add_track(self, name: str, group: int | None = None) -> int:
        """Add a track to a group, which is also a track, and return its number."""
        self._tracks += 1
        track = TrackDescriptor(
            uuid=self._tracks,
            parent_uuid=group,
            name=name,
            child_ordering=TrackDescriptor.EXPLICIT,
            sibling_order_rank=self._tracks,
        )
        self._builder.write_packet(TracePacket(track_descriptor=track))
        return self._tracks

    def add(
        self,
        track: int,
        time_ns: int,
        kind: int,
        name: str | None = None,
        values: Mapping[str, int | str] | None = None,
        **flows: Sequence[int],
    ) -> None:
        """Add an event to a track.

        Args:
            track: Number of the track.
            time_ns: CLOCK_MONOTONIC.
            kind: `BEGIN` or `END` of a slice, or `INSTANT`.
            name: Name of the slice or instant.
            values: Values that are shown with it, by name.
            flows: Numbers of the arrows that begin (`flow_ids`) or end (`terminating_flow_ids`).
        """
        notes = [
            {"name": key, "string_value" if isinstance(value, str) else "int_value": value}
            for key, value in (values or {}).items()
        ]
        event = {"type": kind, "track_uuid": track, "name": name, "debug_annotations": notes}
        packet = TracePacket(
            # A run that continues another one takes over its events, which are older.
            timestamp=max(0, time_ns - self._origin_ns),
            trusted_packet_sequence_id=1,
            track_event=event | flows,
        )
        self._builder.write_packet(packet)
        self.count += kind != END


def export_trace(recording: Recording, path: Path, show_progress: Callable[[float], None]) -> int:
    """Write a recording as a trace for Perfetto.

    Args:
        recording: The recording.
        path: File to write.
        show_progress: Called with the completed fraction, 0 to 1.

    Returns:
        Number of slices and instants in the file.

    Raises:
        Failure: The recording has no cycles.
    """
    cycles = recording.cycles
    if not cycles:
        raise Failure(f"{recording.folder}: no cycle is recorded, so the trace would be empty", 2)
    with path.open("wb") as file:
        writer = PerfettoWriter(file, min(int(rows["start_ns"].min()) for rows in cycles.values()))
        boards = writer.add_track("boards")
        tracks = {
            task.name: writer.add_track(task.name, boards)
            for task in recording.layout.tasks
            if task.name in cycles
        }
        arrows = _write_messages(recording, writer, tracks)
        for number, (task, track) in enumerate(tracks.items()):
            _write_cycles(writer, track, cycles[task], recording.layout.clock_ns, arrows[task])
            show_progress((number + 1) / len(tracks))
        _write_cores(recording, writer)
        _write_events(recording, writer, tracks)
    return writer.count


def _write_messages(
    recording: Recording, writer: PerfettoWriter, tracks: dict[str, int]
) -> dict[str, dict[int, list[int]]]:
    """Write an instant for each message that another task read.

    Returns:
        Numbers of the arrows that end at the cycles of each task, by index of the cycle.
    """
    arrow = 0
    ends: dict[str, dict[int, list[int]]] = defaultdict(lambda: defaultdict(list))
    for name in recording.mailboxes:
        box = recording.layout.find_mailbox(name)
        if box.writer not in tracks:
            continue
        stamps = recording.read_signal(name, "stamp_ns")
        visible = recording.read_signal(name, "visible_at")
        begins: dict[int, list[int]] = defaultdict(list)
        for reader in sorted(tracks.keys() & {*box.readers} - {box.writer}):
            for row, cycle in _find_readings(recording, box, reader, stamps, visible):
                arrow += 1
                begins[row].append(arrow)
                ends[reader][cycle].append(arrow)
        for row, arrows in begins.items():
            writer.add(tracks[box.writer], int(stamps[row]), INSTANT, name, flow_ids=arrows)
    return ends


def _find_readings(
    recording: Recording, box: MailboxSpec, reader: str, stamps: np.ndarray, visible: np.ndarray
) -> Iterator[tuple[int, int]]:
    """Yield the messages of a mailbox that a task read, each with the first cycle that read it.

    Args:
        recording: The recording.
        box: The mailbox.
        reader: The task.
        stamps: Time stamps of the messages, shape (messages,).
        visible: Ticks at which they became visible, shape (messages,).

    Yields:
        Index of the message, and index of the cycle in the reader's trace.
    """
    rows = recording.cycles[reader]
    cycles = np.arange(len(rows))
    if box.is_repeatable:
        grid = recording.layout.find_read_grid(box, reader)
        cycles = np.flatnonzero((rows["tick"] - grid.phase) % grid.every == 0)
        first = np.searchsorted(rows["tick"][cycles], np.maximum.accumulate(visible))
    else:
        first = np.searchsorted(rows["start_ns"], stamps)
    # Readers of a queue take every message, and others only the newest one.
    taken = (first < len(cycles)) & ((np.diff(first, append=-1) != 0) | (box.protocol == "queue"))
    # A flight recorder does not know what was read first after a gap.
    stretches = recording.find_stretches(visible)
    reader_stretches = recording.find_stretches(rows["tick"])
    for row in np.flatnonzero(taken).tolist():
        cycle = int(cycles[first[row]])
        is_before = stamps[row] <= rows["read_ns"][cycle]
        if is_before and stretches[row] == reader_stretches[cycle]:
            yield row, cycle


def _write_cycles(
    writer: PerfettoWriter,
    track: int,
    rows: np.ndarray,
    clock_ns: int,
    arrows: Mapping[int, Sequence[int]],
) -> None:
    """Write the cycles of a task.

    Args:
        writer: Writer of the trace.
        track: Number of the task's track.
        rows: Trace records of the task.
        clock_ns: Length of a tick.
        arrows: Numbers of the arrows that end at a cycle, by index of the cycle.
    """
    missed = find_missed_cycles(rows)
    skipped = count_skipped_releases(rows)
    for cycle, row in enumerate(rows):
        start, read, process, end = (
            int(row[name]) for name in ("start_ns", "read_ns", "process_ns", "end_ns")
        )
        tick = int(row["tick"])
        values = {"tick": tick, "sim_ns": tick * clock_ns}
        if skipped[cycle]:
            writer.add(track, start, INSTANT, "skipped", {"releases": int(skipped[cycle])})
        writer.add(track, start, BEGIN, "cycle", values)
        writer.add(track, start, BEGIN, "read", terminating_flow_ids=arrows.get(cycle, ()))
        for name, at in (("process", read), ("write", process)):
            writer.add(track, at, END)
            writer.add(track, at, BEGIN, name)
        writer.add(track, end, END)
        writer.add(track, end, END)
        if missed[cycle]:
            writer.add(track, end, INSTANT, "missed", values)


def _write_cores(recording: Recording, writer: PerfettoWriter) -> None:
    """Write the cycles on each core. A cycle that preempted another one is shown within it."""
    spans: dict[int, list[tuple[int, int, str]]] = defaultdict(list)
    for task in recording.layout.tasks:
        core, _ = recording.find_core_and_priority(task)
        for row in recording.read_trace(task.name):
            # Of cycles that start at the same time, the longest comes first.
            spans[core].append((int(row["start_ns"]), -int(row["end_ns"]), task.name))
    group = writer.add_track("cores")
    for core, cycles in sorted(spans.items()):
        track = writer.add_track(f"core {core}", group)
        open_ends: list[int] = []
        for start, minus_end, task_name in sorted(cycles):
            # A slice must end within the one around it. If a cycle outlasts the one that it
            # interrupted, the interrupted one is cut off.
            while open_ends and (open_ends[-1] <= start or open_ends[-1] < -minus_end):
                writer.add(track, min(open_ends.pop(), start), END)
            writer.add(track, start, BEGIN, task_name)
            open_ends.append(-minus_end)
        while open_ends:
            writer.add(track, open_ends.pop(), END)


def _write_events(recording: Recording, writer: PerfettoWriter, tracks: dict[str, int]) -> None:
    """Write the events of the run on the tracks of their boards, except events before tick 0."""
    others = writer.add_track("events")
    offset_ns = recording.launch.wall_offset_ns
    for event in recording.events:
        if event.get("tick", -1) >= 0:
            values = {key: event[key] for key in ("text", "code", "subject", "tick")}
            track = tracks.get(event["board"], others)
            writer.add(track, event["time_ns"] - offset_ns, INSTANT, event["kind"], values)
