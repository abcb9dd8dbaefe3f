"""A writing task and a reading task at the two ends of one mailbox, cycled by a test, tick by
tick."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic_ns
from typing import Any, NamedTuple
from unittest.mock import patch

from rack.backplane.fault_table import FaultEntry, FaultTable, Injection
from rack.backplane.layout import Protocol
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.interrupt import open_inbox
from rack.backplane.mailbox.protocols import LockReader
from rack.backplane.segment import SHM_FOLDER, Segment, unlink_segment
from rack.backplane.trace import FIELDS, Flag, TraceWriter
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.backplane.words import Block
from rack.boards.faults.kind import KINDS
from rack.boards.run import port_tables, ports
from rack.boards.run.ports import InputPorts, OutputPorts
from rack.levels.level import Reading
from tests.backplane.bus import NAME, layout, mailbox, task
from tests.bare_level import BareLevel

COUNTED = ("stage", "struck_tick", "hidden", "count")
"""Words of a fault's entry that do not depend on time."""


class Seen(NamedTuple):
    """What a read gave: its tick, the release tick that the message holds, -1 for none, and what
    was said of it."""

    tick: int
    released: int
    verdict: str
    is_lost: bool


@contextmanager
def accesses(are_compiled: bool) -> Iterator[None]:
    """Let ports that are opened here be accessed by machine code, where it can, or all by the
    Python classes."""
    if are_compiled:
        yield
        return
    with (
        patch.object(ports, "can_write", lambda writer: False),
        patch.object(port_tables, "can_read", lambda line: False),
    ):
        yield


class WritingTask:
    """The task `writer`: each of its messages holds its release tick in every place."""

    def __init__(self, segment: Segment, is_compiled: bool = True) -> None:
        self.every = segment.layout.find_task("writer").every
        alarms = AlarmWriter(segment, "writer")
        self.level = BareLevel()
        inputs = InputPorts(segment, self.level, {}, alarms)
        with accesses(is_compiled):
            self.ports = OutputPorts(segment, self.level, {"point": NAME}, alarms, inputs)
        self._block, self._trace = segment.get_block("writer"), TraceWriter(segment, "writer")

    def cycle(self, tick: int, now: int | None = None) -> bool:
        """Write, trace the cycle, say that it is done; the clock stands at `now`, or its end has
        not come."""
        message = self.level.ports["point"]
        message.id, message.row = tick, tick
        cut_off = self.ports.bus_errors
        in_time = self.ports.write(tick, now)
        self.end(tick, int(Flag.BUS_ERROR) if self.ports.bus_errors > cut_off else 0)
        return in_time

    def end(self, tick: int, flags: int = 0) -> None:
        """Trace a cycle and say that it is done."""
        record = dict.fromkeys(FIELDS, 0) | {"tick": tick, "end_ns": monotonic_ns(), "flags": flags}
        self._trace.write(*record.values())
        self._block[Block.DONE] = tick

    def close(self) -> None:
        """Give the mailbox back, as the end of its process does."""
        for writer in self.ports.writers.values():
            writer.close()


class ReadingTask:
    """The task `reader`; `seen` is what its reads gave."""

    def __init__(self, segment: Segment, is_compiled: bool = True) -> None:
        self.every = segment.layout.find_task("reader").every
        self.level = BareLevel()
        with accesses(is_compiled):
            self.ports = InputPorts(
                segment,
                self.level,
                {"point": NAME},
                AlarmWriter(segment, "reader"),
                inbox=open_inbox(segment, "reader"),
            )
        self.seen: list[Seen] = []

    def cycle(self, tick: int) -> Reading:
        """Read once."""
        self.ports.read(tick)
        reading: Reading[Any] = self.level.ports["point"]
        row = reading.message.row
        assert (row == reading.message.id).all(), "half a message, or a forged one"
        released = reading.message.id if reading.has_message else -1
        self.seen.append(Seen(tick, released, reading.verdict.name, reading.is_lost))
        return reading


class Link:
    """Both tasks. When both are due the reader comes first, or the writer, as their processors have
    it."""

    def __init__(
        self, segment: Segment, reader_first: bool = False, is_compiled: bool = True
    ) -> None:
        self.segment = segment
        self.writer = WritingTask(segment, is_compiled)
        self.reader = ReadingTask(segment, is_compiled)
        self.active: list[FaultEntry] = []
        self._reader_first = reader_first
        self._rings = {name: open_alarm_ring(segment, name) for name in ("writer", "reader")}

    def close(self) -> None:
        """Give back what the tasks and the bus hold."""
        self.writer.close()
        for reader in self.reader.ports.readers.values():
            if isinstance(reader, LockReader):
                reader.lock.close()
        self.segment.close()

    def run(self, first: int, last: int, writes: bool = True, reads: bool = True) -> None:
        """Do the ticks from `first` up to and without `last`, of both ends or of one."""
        for tick in range(first, last):
            ends = ((self.writer, writes), (self.reader, reads))
            due = [end for end, does in ends if does and tick % end.every == 0]
            for end in reversed(due) if self._reader_first else due:
                end.cycle(tick)

    def fault(self, kind: str, *parameters: float, seed: int = 7, mailbox: int = -1) -> FaultEntry:
        """Write with one more fault from now on."""
        defaults = [p.default or 0.0 for p in KINDS[kind].parameters]
        given = (*parameters, *defaults[len(parameters) :])
        entry = FaultTable(self.segment).add_fault(
            Injection(KINDS[kind].number, 0, mailbox, seed=seed, parameters=given)
        )
        self.active.append(entry)
        self.writer.ports.apply_faults(self.active)
        return entry

    def heal(self) -> None:
        """Write without faults from now on."""
        self.active.clear()
        self.writer.ports.apply_faults([])

    def written(self) -> list[tuple[int, int, int]]:
        """Return release tick, serial and first visible tick of every message in a slot, oldest
        first."""
        rows = MailboxRing(self.segment, NAME).read_new_rows().rows
        return [(int(row["tick"]), int(row["serial"]), int(row["visible_at"])) for row in rows]

    def rung(self, task: str) -> list[tuple[object, ...]]:
        """Return what a task has rung since the last call, but for the time."""
        rows = self._rings[task].read_new_rows().rows
        names = [name for name in rows.dtype.names or () if name != "time_ns"]
        return [tuple(row) for row in rows[names].tolist()]

    def alarms(self, task: str = "reader") -> list[tuple[int, Alarm]]:
        """Return tick and code of what a task has rung since the last call."""
        rows = self._rings[task].read_new_rows().rows
        return [(int(row["tick"]), Alarm(row["code"])) for row in rows]


def story(rack: Link, kind: str, *parameters: float) -> dict[str, object]:
    """Let a link live through two spells of a fault, and pauses of either end; return all that it
    leaves, but for times."""
    entries = []
    written = []
    for begin in (0, 400):
        rack.run(begin, begin + 60)
        entries.append(rack.fault(kind, *parameters, seed=begin + 3))
        rack.run(begin + 60, begin + 120)
        rack.heal()
        rack.run(begin + 120, begin + 240)
        rack.run(begin + 240, begin + 264, writes=False)
        rack.run(begin + 264, begin + 296, reads=False)
        rack.run(begin + 296, begin + 400)
        written += rack.written()
    writer = rack.writer.ports.writers["point"]
    reader = rack.reader.ports.readers[NAME]
    statistics = reader.statistics
    return {
        "seen": rack.reader.seen,
        "written": written,
        "reader": rack.rung("reader"),
        "writer": rack.rung("writer"),
        "struck": [[getattr(entry, word) for word in COUNTED] for entry in entries],
        "statistics": {
            name: getattr(statistics, name) for name in statistics.__slots__ if name != "forger"
        },
        "ends": [
            *(writer.serial, writer.bus_errors),
            *(reader.serial, reader.accesses, reader.transfers),
        ],
    }


MakeLink = Callable[..., Link]


@contextmanager
def links(rack: str) -> Iterator[MakeLink]:
    """Make the links of a test, then remove them; a link's writer writes in every n-th of its
    cycles."""
    made: list[Link] = []

    def make(
        protocol: Protocol = "time-slice",
        rates: tuple[int, int] = (1, 1),
        reader_first: bool = False,
        depth: int = 1024,
        cycles: int = 1,
        is_compiled: bool = True,
    ) -> Link:
        box = mailbox(protocol, every=cycles * rates[0], delay=rates[0], depth=depth)
        tasks = task("writer", every=rates[0], depth=64), task("reader", every=rates[1], slot=3)
        segment = Segment.create(layout(f"{rack}-{len(made)}", [box], tasks), "")
        made.append(Link(segment, reader_first, is_compiled))
        return made[-1]

    yield make
    for found in made:
        found.close()
        unlink_segment(found.segment.rack)
    assert not [path.name for path in SHM_FOLDER.iterdir() if rack in path.name]
