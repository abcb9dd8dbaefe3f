"""A task's ports on the bus: readers and writers of its mailboxes, filled once a cycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rack.backplane.alarms import Alarm, AlarmWriter
from rack.backplane.episodes import Episodes
from rack.backplane.fault_table import Entry, FaultEntry
from rack.backplane.mailbox import Writer
from rack.backplane.message import Message
from rack.backplane.protocols import open_writer
from rack.backplane.segment import Segment
from rack.backplane.silence_watch import Witness
from rack.backplane.watched_reader import watched
from rack.boards.faults.messages import FaultyWriter
from rack.levels.level import Ports, Reading, Verdict


class InputPorts:
    """The mailboxes that a task reads, watched; `values` holds what the last `read` gave, by port."""

    def __init__(self, segment: Segment, mailboxes: Mapping[str, str], alarms: AlarmWriter, plan: str = "") -> None:
        """Read `mailboxes` by port; `plan` is the one that holds the task's own plan."""
        self._witness = Witness()
        found = {port: watched(segment, name, alarms, self._witness) for port, name in mailboxes.items()}
        self.readers = {port: one.reader for port, one in found.items()}
        self.values = Ports(**{port: Reading(r.message, Verdict.NONE) for port, r in self.readers.items()})
        slots = [(self.values.__dict__, port, one.read) for port, one in found.items()]
        self._plan = [slot for slot in slots if mailboxes[slot[1]] == plan]
        self._rest = [slot for slot in slots if mailboxes[slot[1]] != plan]
        self._counted = self._traffic

    def read(self, tick: int) -> None:
        """Sample every mailbox as of `tick`."""
        self.read_plan(tick)
        self.read_rest(tick)

    def read_plan(self, tick: int) -> None:
        """Begin to sample as of `tick`, with the plan where the task reads one."""
        self._witness.reads(tick)
        for values, port, read in self._plan:
            values[port] = read(tick)

    def read_rest(self, tick: int) -> None:
        """Sample every other mailbox: commands, statuses, world model."""
        for values, port, read in self._rest:
            values[port] = read(tick)

    @property
    def bus_errors(self) -> int:
        """Reads so far that their bound cut off."""
        return sum([reader.bus_errors for reader in self.readers.values()])

    @property
    def corrupt(self) -> int:
        """Reads so far that found a damaged message."""
        return sum([reader.corrupt for reader in self.readers.values()])

    def basis(self, port: str, tick: int) -> int:
        """Return the tick on which the information of a port rests; `tick` where there is none."""
        reader = self.readers.get(port)
        return reader.basis if reader is not None and reader.serial else tick

    def take_traffic(self) -> tuple[int, int]:
        """Return the accesses, and the bytes read, since the last call."""
        before, self._counted = self._counted, self._traffic
        return self._counted[0] - before[0], self._counted[1] - before[1]

    @property
    def _traffic(self) -> tuple[int, int]:
        readers = self.readers.values()
        return sum(r.accesses for r in readers), sum(r.transfers * r.spec.size for r in readers)


class OutputPorts:
    """The mailboxes that a task writes; `messages` holds the outgoing message of each port."""

    def __init__(self, segment: Segment, mailboxes: Mapping[str, str], alarms: AlarmWriter) -> None:
        self.writers = {port: open_writer(segment, name) for port, name in mailboxes.items()}
        self.messages = Ports(**{port: writer.message for port, writer in self.writers.items()})
        self._episodes = {port: Episodes(segment, name, alarms) for port, name in mailboxes.items()}
        self._indices = {spec.name: index for index, spec in enumerate(segment.layout.mailboxes)}
        self._faulty: dict[str, FaultyWriter] = {}
        self._held_up = dict.fromkeys(self.writers, 0)
        self._counted = self._traffic
        self._route()

    def apply(self, faults: Sequence[tuple[str, FaultEntry]]) -> None:
        """Write with these faults, by kind, from now on; what an earlier one holds back comes with the next write."""
        for port, writer in self.writers.items():
            index = self._indices[writer.spec.name]
            chosen = [(kind, entry) for kind, entry in faults if entry[Entry.MAILBOX] in (-1, index)]
            if chosen or port in self._faulty:
                self._faulty.setdefault(port, FaultyWriter(writer, index)).apply(chosen)
        self._route()

    def _route(self) -> None:
        """Lead each port to its writer, or to the faulty one around it."""
        self._lines = [(port, w, getattr(self._faulty.get(port), "write", w.write)) for port, w in self.writers.items()]

    def message(self, port: str) -> Message | None:
        """Return the outgoing message of a port, if there is such a port."""
        writer = self.writers.get(port)
        return writer.message if writer else None

    @property
    def bus_errors(self) -> int:
        """Writes so far that their bound cut off."""
        return sum([writer.bus_errors for writer in self.writers.values()])

    def write(self, tick: int, now: int, inputs: InputPorts) -> bool:
        """Write every mailbox; False when one came too late.

        Each message carries the tick on which its information rests: a command that of the command it
        follows, a status that of the status below it. So the response of the whole system is measured.
        """
        in_time = True
        for port, writer, write in self._lines:
            in_time = write(tick, now, inputs.basis(port, tick)) and in_time
            if writer.intruder or writer.held_up:
                self._tell(port, writer, tick)
        if self._faulty:
            self._leave_faults()
        return in_time

    def flush(self, tick: int, now: int) -> None:
        """Publish what a fault has held back and what is due: for a cycle in which nothing is written."""
        if self._faulty:
            for faulty in self._faulty.values():
                faulty.flush(tick, now)
            self._leave_faults()

    def _leave_faults(self) -> None:
        """Write plainly again where no fault is left, and nothing held back."""
        over = [port for port, faulty in self._faulty.items() if faulty.is_over]
        for port in over:
            del self._faulty[port]
        if over:
            self._route()

    def _tell(self, port: str, writer: Writer, tick: int) -> None:
        """Ring for what a writer has found in its own mailbox."""
        if writer.intruder:
            self._episodes[port].find(Alarm.MASQUERADE, writer.serial, tick, writer.intruder)
            writer.intruder = 0
        if writer.held_up != self._held_up[port]:
            self._held_up[port] = writer.held_up
            self._episodes[port].find(Alarm.LOCKED, writer.serial, tick)

    def take_traffic(self) -> tuple[int, int]:
        """Return the messages, and the bytes, written since the last call."""
        before, self._counted = self._counted, self._traffic
        return self._counted[0] - before[0], self._counted[1] - before[1]

    @property
    def _traffic(self) -> tuple[int, int]:
        writers = self.writers.values()
        return sum(w.serial for w in writers), sum(w.serial * w.spec.size for w in writers)
