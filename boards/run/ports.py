"""A task's ports on the bus: the readers and writers of its mailboxes, used once per cycle."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

from rack.backplane.fault_table import FaultEntry
from rack.backplane.layout import ExchangeSpec
from rack.backplane.mailbox.interrupt import BoardInbox
from rack.backplane.mailbox.mailbox import Reader, Writer
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.mailbox.queue import ALL, QueueWriter, taken_name
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, Episodes
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.watch.watched_reader import GridReader, watched
from rack.boards.exchange import Taken
from rack.boards.faults.kind import kind_of
from rack.boards.faults.messages import FaultyWriter
from rack.boards.run.queues import DemandPort, QueuePort, Write
from rack.boards.wiring import Source
from rack.levels.level import Ports, Reading, Verdict

Line = tuple[dict[str, Reading], str, Callable[[int], Reading]]
"""One mailbox to read: where its reading goes, and the function that reads it as of a tick."""


def all_of(port: str) -> int:
    """Return room for every message of a queue."""
    return ALL


class InputPorts:
    """The mailboxes that a task reads, watched; `values` holds the last `Reading` of each port.

    `readers` holds the reader of each mailbox, `taken` every mailbox in the order of the ports.
    """

    def __init__(
        self,
        segment: Segment,
        sources: Mapping[str, Source],
        alarms: AlarmWriter,
        plan: str = "",
        *,
        room: Callable[[str], int] = all_of,
        exchange: Mapping[str, ExchangeSpec] | None = None,
        inbox: BoardInbox | None = None,
    ) -> None:
        """Read `sources` by port, from a queue as many messages as there is `room` for on its port.

        `plan` is the mailbox that holds the task's own plan, `exchange` the ports that are not
        simply read in every cycle, `inbox` that of the task's board.
        """
        self.task = ReadingTask(inbox)
        self.taken: list[Taken] = []
        self.values = Ports()
        self.readers: dict[str, Reader] = {}
        # Where each reading goes: the ports themselves, or the dict of a port that reads many
        # mailboxes.
        self._plan: list[Line] = []
        self._rest: list[Line] = []
        for port, source in sources.items():
            by_board: dict[str, Reading] = {}
            boxes = {port: source} if isinstance(source, str) else source
            values = self.values.__dict__ if isinstance(source, str) else by_board
            how = (exchange or {}).get(port)
            open_port = partial(
                watched, segment, alarms=alarms, task=self.task, room=partial(room, port)
            )
            for key, mailbox in boxes.items():
                found = open_port(mailbox, asynchronous=how is not None and how.asynchronous)
                read = found.read if how is None else GridReader(found, how.grid).read
                values[key] = Reading(found.reader.message, Verdict.NONE)
                (self._plan if mailbox == plan else self._rest).append((values, key, read))
                self.taken.append(Taken(values, key, found.reader))
                self.readers[mailbox] = found.reader
            if not isinstance(source, str):
                setattr(self.values, port, by_board)
        self.reads_plan = bool(self._plan)
        self._readers = [entry.reader for entry in self.taken]
        self._statistics = [reader.statistics for reader in self._readers]
        self._counted = self._traffic

    def follow(self, segment: Segment, queue: QueuePort, alarms: AlarmWriter) -> None:
        """Read the position of the reader of a queue that the task writes, with the mailboxes of
        its ports."""
        found = watched(segment, taken_name(queue.writer.spec.name), alarms, self.task)
        self._rest.append(({}, "", queue.noting(found.read)))
        self._readers.append(found.reader)
        self._statistics.append(found.reader.statistics)

    def read(self, tick: int) -> None:
        """Read every mailbox as of `tick`."""
        self.task.reads(tick)
        self.exchange(tick)
        self.read_command_and_status(tick)

    def exchange(self, tick: int) -> None:
        """Transfer the plan over the bus, as of `tick`."""
        for values, key, read in self._plan:
            values[key] = read(tick)

    def read_command_and_status(self, tick: int) -> None:
        """Read every other mailbox as of `tick`: commands, statuses, world model."""
        for values, key, read in self._rest:
            values[key] = read(tick)

    @property
    def bus_errors(self) -> int:
        """Number of reads that timed out."""
        return sum([statistics.bus_errors for statistics in self._statistics])

    @property
    def corrupt(self) -> int:
        """Number of reads that found a damaged message."""
        return sum([statistics.corrupt for statistics in self._statistics])

    def take_traffic(self) -> tuple[int, int]:
        """Return the number of accesses and of bytes read since the last call."""
        before = self._counted
        self._counted = self._traffic
        return self._counted[0] - before[0], self._counted[1] - before[1]

    @property
    def _traffic(self) -> tuple[int, int]:
        accesses = sum(reader.accesses for reader in self._readers)
        return accesses, sum(reader.transfers * reader.spec.size for reader in self._readers)


class OldestOf:
    """The basis of what rests on several mailboxes: the oldest of those that hold a message. As of
    a `Reader`."""

    def __init__(self, readers: Sequence[Reader]) -> None:
        self._readers = readers

    @property
    def serial(self) -> int:
        """Serial of one of the messages; 0: there is none."""
        return max([reader.serial for reader in self._readers])

    @property
    def basis(self) -> int:
        """Tick of the oldest information that the last good messages rest on."""
        return min([reader.basis for reader in self._readers if reader.serial])


class OutputPorts:
    """The mailboxes that a task writes; `messages` holds the outgoing message of each port.

    Each message carries the tick of the oldest information that it rests on. A command inherits the
    tick of the command that it follows, a status that of the status below: see `Output.rests_on`.
    So the system's response time can be measured.
    """

    def __init__(
        self,
        segment: Segment,
        mailboxes: Mapping[str, str],
        alarms: AlarmWriter,
        inputs: InputPorts,
        sent: Collection[str] = (),
    ) -> None:
        """Write `mailboxes` by port. `inputs`: what the task reads. `sent`: the ports whose level
        sends by itself."""
        self.writers = {port: open_writer(segment, name) for port, name in mailboxes.items()}
        self._demanded = {
            port: DemandPort(writer) for port, writer in self.writers.items() if writer.spec.max_age
        }
        messages = {port: writer.message for port, writer in self.writers.items()}
        self.messages = Ports(
            **messages | {port: demanded.message for port, demanded in self._demanded.items()}
        )
        self._rests_on = {
            port: _basis(w.spec.rests_on, inputs.readers) for port, w in self.writers.items()
        }
        self._episodes = {port: Episodes(segment, name, alarms) for port, name in mailboxes.items()}
        self._layout = segment.layout
        self._queues = {
            port: QueuePort(writer, self._episodes[port], port in sent)
            for port, writer in self.writers.items()
            if isinstance(writer, QueueWriter)
        }
        for queue in self._queues.values():
            inputs.follow(segment, queue, alarms)
        self._faulty: dict[str, FaultyWriter] = {}
        self._held_up = dict.fromkeys(self.writers, 0)
        self._writers = list(self.writers.values())
        self._counted = self._traffic
        self._route()

    def apply(self, faults: Sequence[FaultEntry]) -> None:
        """Apply these faults from now on; messages delayed by earlier ones go out with
        the next write."""
        for port, writer in self.writers.items():
            index = self._layout.index(writer.spec.name)
            chosen = [
                entry
                for entry in faults
                if entry.mailbox in (-1, index)
                and not (port in self._queues and kind_of(entry).not_queued)
            ]
            if chosen or port in self._faulty:
                self._faulty.setdefault(port, FaultyWriter(writer, index)).apply(chosen)
        self._route()

    def _route(self) -> None:
        """Route each port to its writer, or to the faulty writer around it."""
        self._lines = [
            (
                port,
                w,
                self._write_of(port),
                self._rests_on[port],
                w.spec.ahead - w.spec.phase,
                w.spec.every,
            )
            for port, w in self.writers.items()
        ]

    def _write_of(self, port: str) -> Write:
        faulty = self._faulty.get(port)
        write: Write = self.writers[port].write if faulty is None else faulty.write
        if port in self._demanded:
            return partial(
                self._demanded[port].write, write, _no_flush if faulty is None else faulty.flush
            )
        return partial(self._queues[port].write, write) if port in self._queues else write

    @property
    def bus_errors(self) -> int:
        """Number of writes that timed out."""
        return sum([writer.bus_errors for writer in self._writers])

    def write(self, tick: int, now: int | None) -> bool:
        """Write every mailbox that is due at `tick`; return False if a message was too late.

        `now`: the clock's tick, if the cycle's end may have passed.
        """
        in_time = True
        for port, writer, write, source, ahead, every in self._lines:
            # A message that is not written in every cycle becomes visible at multiples of its
            # period, from its phase.
            if (tick + ahead) % every:
                if port in self._faulty:
                    self._faulty[port].flush(tick, now)
                continue
            if not write(tick, now, source.basis if source is not None and source.serial else tick):
                in_time = False
            if writer.intruder or writer.held_up:
                self._report(port, writer, tick)
        if self._faulty:
            self._drop_faulty_writers()
        return in_time

    def flush(self, tick: int, now: int | None) -> None:
        """Publish delayed messages that are due, in a cycle that writes nothing."""
        if self._faulty:
            for faulty in self._faulty.values():
                faulty.flush(tick, now)
            self._drop_faulty_writers()

    def _drop_faulty_writers(self) -> None:
        """Write directly again where no fault and no delayed message is left."""
        over = [port for port, faulty in self._faulty.items() if faulty.is_over]
        for port in over:
            del self._faulty[port]
        if over:
            self._route()

    def _report(self, port: str, writer: Writer, tick: int) -> None:
        """Raise an alarm for a writer's findings in its own mailbox."""
        if writer.intruder:
            self._episodes[port].find(Alarm.MASQUERADE, writer.serial, tick, writer.intruder)
            writer.intruder = 0
        if writer.held_up != self._held_up[port]:
            self._held_up[port] = writer.held_up
            self._episodes[port].find(Alarm.LOCKED, writer.serial, tick)

    def take_traffic(self) -> tuple[int, int]:
        """Return the number of messages and of bytes written since the last call."""
        before = self._counted
        self._counted = self._traffic
        return self._counted[0] - before[0], self._counted[1] - before[1]

    @property
    def _traffic(self) -> tuple[int, int]:
        writers = self.writers.values()
        return sum(w.serial for w in writers), sum(w.serial * w.spec.size for w in writers)


def _no_flush(tick: int, now: int | None) -> None:
    """Flush nothing: no fault delays messages."""


def _basis(mailboxes: Sequence[str], readers: Mapping[str, Reader]) -> Reader | OldestOf | None:
    """Return what gives the basis of a message that rests on these mailboxes; None: it rests on
    nothing read."""
    found = [readers[name] for name in mailboxes]
    return OldestOf(found) if len(found) > 1 else next(iter(found), None)
