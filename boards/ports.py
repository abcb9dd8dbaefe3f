"""A task's ports on the bus: readers and writers of its mailboxes, filled once a cycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from backplane.alarms import AlarmWriter
from backplane.fault_table import FaultEntry
from backplane.message import Message
from backplane.protocols import open_reader, open_writer
from backplane.segment import Segment
from levels.level import Ports, Reading, Verdict


class InputPorts:
    """The mailboxes that a task reads; `values` holds what the last `read` gave, by port."""

    def __init__(self, segment: Segment, mailboxes: Mapping[str, str], alarms: AlarmWriter) -> None:
        self.readers = {port: open_reader(segment, name) for port, name in mailboxes.items()}
        self.values = Ports(**{port: Reading(r.message, Verdict.NONE) for port, r in self.readers.items()})
        self._slots = [(self.values.__dict__, port, reader.read) for port, reader in self.readers.items()]

    def read(self, tick: int) -> None:
        """Sample every mailbox as of `tick`: commands, statuses, plan, world model."""
        for values, port, read in self._slots:
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


class OutputPorts:
    """The mailboxes that a task writes; `messages` holds the outgoing message of each port."""

    def __init__(self, segment: Segment, mailboxes: Mapping[str, str], alarms: AlarmWriter) -> None:
        self.writers = {port: open_writer(segment, name) for port, name in mailboxes.items()}
        self.messages = Ports(**{port: writer.message for port, writer in self.writers.items()})

    def apply(self, faults: Sequence[tuple[str, FaultEntry]]) -> None:
        """Write with these faults from now on."""

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
        for port, writer in self.writers.items():
            in_time = writer.write(tick, now, inputs.basis(port, tick)) and in_time
        return in_time
