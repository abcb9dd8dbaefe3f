"""Ports of a task: the readers and writers of its mailboxes, each used at most once per cycle."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial

from rack.backplane.fault_table import FaultEntry
from rack.backplane.layout import ExchangeSpec
from rack.backplane.mailbox.interrupt import BoardInbox
from rack.backplane.mailbox.mailbox import Reader, Writer
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.mailbox.queue import QueueWriter
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm, AlarmWriter, Episodes
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.watch.watched_reader import GridReader, WatchedReader, open_watched
from rack.boards.exchange import InputMailbox
from rack.boards.faults.kind import find_kind
from rack.boards.faults.message_steps import FaultyWriter
from rack.boards.run.port_tables import ReadTable, WriteTable, can_write
from rack.boards.wiring import Source
from rack.levels.level import LevelSection
from rack.levels.ports import Sender


class InputPorts:
    """The mailboxes that a task reads and checks. The level gets the last `Reading` of each port.

    Attributes:
        task: State of the reading task.
        readers: Readers of the mailboxes, keyed by the name of the mailbox.
        mailboxes: Mailboxes with their last readings, in the order of the ports.
        reads_plan: True if the task reads the plan of its level.
    """

    def __init__(
        self,
        segment: Segment,
        level: LevelSection,
        sources: Mapping[str, Source],
        alarms: AlarmWriter,
        plan: str = "",
        *,
        exchange: Mapping[str, ExchangeSpec] | None = None,
        inbox: BoardInbox | None = None,
    ) -> None:
        """Open the mailboxes.

        Args:
            segment: Memory of the rack.
            level: The level that reads. It decides how many messages to take from a queue.
            sources: Mailboxes of each port.
            alarms: Alarm ring of the task.
            plan: Mailbox with the plan of the task's level.
            exchange: Rules for ports that are read at a different rate or asynchronously.
            inbox: Inbox of the task's board. None if nothing interrupts it.
        """
        self.task = ReadingTask(inbox)
        self.mailboxes: list[InputMailbox] = []
        self.readers: dict[str, Reader] = {}
        # A reading is stored under the name of its port. A port that reads several mailboxes has a
        # dictionary of readings there.
        self._plans: list[InputMailbox] = []
        self._rest: list[InputMailbox] = []
        for port, source in sources.items():
            boxes = {port: source} if isinstance(source, str) else source
            values = level.find_input_table(port)
            if not isinstance(source, str):
                values[port] = values = {}
            rule = (exchange or {}).get(port)
            for key, mailbox in boxes.items():
                if port in level.inputs:
                    segment.message_classes[mailbox] = level.inputs[port].message
                watcher = open_watched(
                    segment,
                    mailbox,
                    alarms,
                    self.task,
                    count_room=partial(level.max_messages, port),
                    asynchronous=rule is not None and rule.asynchronous,
                )
                values[key] = watcher.reader.get_reading(False)
                line = InputMailbox(
                    values, key, watcher if rule is None else GridReader(watcher, rule.grid)
                )
                (self._plans if mailbox == plan else self._rest).append(line)
                self.mailboxes.append(line)
                self.readers[mailbox] = watcher.reader
        self.reads_plan = bool(self._plans)
        self._plan_table = ReadTable(self._plans)
        self._table = ReadTable(self._rest)

    def read_queue_position(
        self, segment: Segment, queue: QueueWriter, alarms: AlarmWriter
    ) -> None:
        """Read, in every cycle, also the mailbox with the position of a queue's reader.

        Args:
            segment: Memory of the rack.
            queue: Writer of the queue, which this task writes.
            alarms: Alarm ring of the task.
        """
        watcher = WatchedReader(segment, queue.position, alarms, self.task)
        self._rest.append(InputMailbox({}, "", watcher))
        self._table = ReadTable(self._rest)

    def read(self, tick: int) -> None:
        """Read every mailbox as of `tick`."""
        self.task.record_read(tick)
        self.exchange_plan(tick)
        self.read_command_and_status(tick)

    def exchange_plan(self, tick: int) -> None:
        """Read the plan as of `tick`. This transfers it over the bus from the planner's core."""
        self._plan_table.read(tick)

    def read_command_and_status(self, tick: int) -> None:
        """Read every mailbox except the plan as of `tick`: commands, statuses and world model."""
        self._table.read(tick)

    @property
    def _readers(self) -> list[Reader]:
        """Readers of all mailboxes, the plan first."""
        return [line.watcher.reader for line in self._plans + self._rest]

    @property
    def bus_errors(self) -> int:
        """Number of reads that timed out."""
        return sum(reader.statistics.bus_errors for reader in self._readers)

    @property
    def corrupt(self) -> int:
        """Number of reads that found a damaged message."""
        return sum(reader.statistics.corrupt for reader in self._readers)

    @property
    def traffic(self) -> tuple[int, int]:
        """Number of reads, and number of bytes copied by them."""
        accesses = sum(reader.accesses for reader in self._readers)
        return accesses, sum(reader.transfers * reader.spec.size for reader in self._readers)


class OutputPort:
    """One mailbox that a task writes.

    The basis of a message is the tick of the oldest information on which it depends: the oldest
    basis of the messages of `sources`. A mailbox with a `max_age` is written on demand, only in
    cycles in which the level has sent a message. Any other mailbox is written in every cycle in
    which it is due. If `sends` is true, the level fills a queue by calling `send`. Otherwise the
    board sends the level's message once in each of these cycles.

    Attributes:
        faulty: Writer that carries out faults. None if no fault acts on the mailbox, and no delayed
            message is still to be published.
    """

    def __init__(
        self,
        segment: Segment,
        writer: Writer,
        alarms: AlarmWriter,
        sources: Sequence[Reader],
        sends: bool,
    ) -> None:
        spec = writer.spec
        self.writer = writer
        self.sources = sources
        self._is_on_demand = spec.max_age > 0
        self._is_sent = not self._is_on_demand
        self._basis: int | None = None
        self._is_queue = isinstance(writer, QueueWriter)
        self._sends_itself = self._is_queue and not sends
        self.value: AnyMessage | Sender[AnyMessage] = writer.message
        """Object that the level gets for its port: the message, or a `Sender`."""
        if self._is_on_demand:
            self.value = Sender(writer.message, self._mark_sent, lambda: 1)
        elif isinstance(writer, QueueWriter) and sends:
            self.value = Sender(writer.message, writer.send, writer.count_free_places)
        self._due_offset = spec.due_offset
        self._index = segment.layout.find_mailbox_index(spec.name)
        self._episodes = Episodes(segment, spec.name, alarms)
        self.faulty: FaultyWriter | None = None
        self._held_up = self._refused = 0

    def _mark_sent(self, basis: int | None = None) -> bool:
        """Request that the message be written in this cycle. Used for mailboxes written on demand.

        Args:
            basis: Tick of the oldest information on which the message depends. None to derive it
                from the messages of `sources`.

        Returns:
            True, because such a message is never refused.
        """
        self._is_sent = True
        self._basis = basis
        return True

    def apply_faults(self, faults: Sequence[FaultEntry]) -> None:
        """Activate the faults in `faults` that concern this mailbox, and no others.

        Args:
            faults: Message faults that are active in the task.
        """
        chosen = [
            entry
            for entry in faults
            if entry.mailbox in (-1, self._index)
            and not (self._is_queue and find_kind(entry).not_queued)
        ]
        if chosen and self.faulty is None:
            self.faulty = FaultyWriter(self.writer, self._index)
        if self.faulty is not None:
            self.faulty.apply_faults(chosen)

    def find_content(self, tick: int) -> bytes | memoryview:
        """Return the message that a standby holds back in the cycle released at `tick`."""
        faulty = self.faulty
        return self.writer.message.raw if faulty is None else faulty.find_content(tick)

    def write(self, tick: int, now: int | None) -> bool:
        """Write the message if it is due, and raise alarms about the mailbox.

        Args:
            tick: Release tick of the cycle.
            now: Current tick. None if the cycle is known to be on time.

        Returns:
            False if the message was published too late.
        """
        writer = self.writer
        if self.faulty is not None and self.faulty.is_over:
            self.faulty = None
        in_time = True
        if (tick + self._due_offset) % writer.spec.every or not self._is_sent:
            self.flush_delayed(tick, now)
        else:
            basis = min([source.basis for source in self.sources if source.serial], default=tick)
            if self._is_on_demand:
                self._is_sent = False
                basis = basis if self._basis is None else self._basis
            elif isinstance(writer, QueueWriter) and self._sends_itself:
                writer.send()
            in_time = (self.faulty or writer).write(tick, now, basis)
        if writer.intruder or writer.held_up or writer.refused:
            self.report_findings(tick)
        return in_time

    def flush_delayed(self, tick: int, now: int | None) -> None:
        """Publish messages that faults have delayed and that are due now."""
        if self.faulty is not None:
            self.faulty.flush_due(tick, now)

    def report_findings(self, tick: int) -> None:
        """Raise alarms about an intruder, refused messages, or a lock held by a dead process."""
        writer = self.writer
        if writer.refused != self._refused:
            refused = writer.refused - self._refused
            self._refused = writer.refused
            self._episodes.record_finding(
                Alarm.QUEUE_FULL, writer.serial + writer.refused, tick, refused
            )
        if writer.intruder:
            self._episodes.record_finding(Alarm.MASQUERADE, writer.serial, tick, writer.intruder)
            writer.intruder = 0
        if writer.held_up != self._held_up:
            self._held_up = writer.held_up
            self._episodes.record_finding(Alarm.LOCKED, writer.serial, tick)


class OutputPorts:
    """The mailboxes that a task writes. The level gets the outgoing message of each port.

    Each message carries the tick of the oldest information on which it depends: for a command, the
    tick of the command from above, for a status, the tick of the status from below (see
    `Output.rests_on`). The response time of the system is measured from these ticks.
    """

    open_writer = staticmethod(open_writer)

    def __init__(
        self,
        segment: Segment,
        level: LevelSection,
        mailboxes: Mapping[str, str],
        alarms: AlarmWriter,
        inputs: InputPorts,
        sent: Collection[str] = (),
    ) -> None:
        """Open the mailboxes.

        Args:
            segment: Memory of the rack.
            level: The level that writes.
            mailboxes: Mailbox of each port.
            alarms: Alarm ring of the task.
            inputs: Input ports of the task.
            sent: Ports whose queues the level fills itself, by calling `send`.
        """
        segment.message_classes |= {
            name: level.outputs[port].message
            for port, name in mailboxes.items()
            if port in level.outputs
        }
        self.writers = {port: self.open_writer(segment, name) for port, name in mailboxes.items()}
        self.ports: list[OutputPort] = []
        for port, writer in self.writers.items():
            sources = [inputs.readers[name] for name in writer.spec.rests_on]
            output = OutputPort(segment, writer, alarms, sources, port in sent)
            self.ports.append(output)
            level.store_output(port, output.value)
            if isinstance(writer, QueueWriter):
                inputs.read_queue_position(segment, writer, alarms)
        self._compiled = [port for port in self.ports if can_write(port.writer)]
        self._table = WriteTable([(port.writer, port.sources) for port in self._compiled])
        self._others = [port for port in self.ports if not can_write(port.writer)]
        self._is_faulty = False

    def apply_faults(self, faults: Sequence[FaultEntry]) -> None:
        """Set the active faults of all mailboxes. Each port applies those that concern it."""
        for port in self.ports:
            port.apply_faults(faults)
        self._is_faulty = any(port.faulty is not None for port in self.ports)

    @property
    def bus_errors(self) -> int:
        """Number of writes that timed out."""
        return sum(writer.bus_errors for writer in self.writers.values())

    def write(self, tick: int, now: int | None) -> bool:
        """Write every mailbox that is due at `tick`.

        Args:
            tick: Release tick of the cycle.
            now: Current tick. None if the cycle is known to be on time.

        Returns:
            False if a message was published too late.
        """
        ports = self.ports
        if now is None and not self._is_faulty:
            ports = self._others
            if self._table.write(tick):
                for port in self._compiled:
                    port.report_findings(tick)
        in_time = True
        for port in ports:
            if not port.write(tick, now):
                in_time = False
        if self._is_faulty:
            self._is_faulty = any(port.faulty is not None for port in self.ports)
        return in_time

    def flush_delayed(self, tick: int, now: int | None) -> None:
        """Publish delayed messages that are due. Call this in a cycle that writes nothing else."""
        for port in self.ports:
            port.flush_delayed(tick, now)

    @property
    def traffic(self) -> tuple[int, int]:
        """Numbers of messages and bytes written by this process and earlier ones of the task."""
        writers = self.writers.values()
        return sum(w.serial for w in writers), sum(w.serial * w.spec.size for w in writers)
