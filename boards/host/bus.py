"""The bus as a program of the host side sees it: `rack.levels.host_program.Bus`, on a segment."""

from __future__ import annotations

import os
import time
from typing import Any

from rack.backplane.byte_lock import ByteLock
from rack.backplane.clock.wake import CHECK_S
from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.host_ring import HostWriter
from rack.backplane.mailbox.mailbox import DoubleBufferReader, Reading
from rack.backplane.message import COMMAND_ID, AnyMessage, Message
from rack.backplane.segment import Segment
from rack.backplane.semaphores import done_semaphore, wake_semaphore
from rack.backplane.words import Block, System, TaskState
from rack.boards.wiring import HostWiring
from rack.levels.host_program import HostProgram

WORD = 8
LONGEST_S = 1e9


class BusReceiver:
    """An input of a program, see `HostReceiver`. Its first read returns the newest message
    alone.
    """

    def __init__(self, reader: DoubleBufferReader) -> None:
        self._reader = reader

    def read(self) -> Reading[AnyMessage]:
        """Return the newest message, with the unread ones before it."""
        before = self._reader.serial
        reading = self._reader.peek()
        return self._reader.with_earlier(reading, before) if before else reading


class BusSender:
    """An output of a program, see `HostSender`."""

    def __init__(self, bus: HostBus, writer: HostWriter, kind: type[Message]) -> None:
        self._bus = bus
        self._writer = writer
        # In the writer's own memory.
        self.message: Any = kind(writer.message.record.dtype, writer.message.raw)
        self._begin()

    def _begin(self) -> None:
        self.message.clear()
        if COMMAND_ID in (self.message.record.dtype.names or ()):
            self.message.id = self.sent + 1

    def send(self) -> bool:
        """Send a copy of the message, and begin the next; False when too many wait."""
        is_sent = self._writer.send(self._bus.tick)
        if is_sent:
            self._begin()
        return is_sent

    @property
    def sent(self) -> int:
        """Number of messages sent so far."""
        return self._writer.serial


class HostBus:
    """The ports of one host board. Opening it claims the board: a second process is refused with
    `MailboxError`.

    A paced program runs in turns, in lockstep, while its adapter waits: see
    `rack.boards.host.bus_adapter`.
    """

    def __init__(self, segment: Segment, wiring: HostWiring) -> None:
        self._segment = segment
        self._words = segment.words
        self._wiring = wiring
        layout = segment.layout
        self._is_paced = self._words[System.LOCKSTEP] and layout.pacers(layout.task(wiring.board))
        self.block = segment.block(wiring.board)
        self._claim = _claim(segment, wiring.board)
        self._writers: dict[str, HostWriter] = {}
        try:
            for port, mailbox in wiring.outputs.items():
                self._writers[port] = HostWriter(segment, mailbox)
        except MailboxError:
            self.close()
            raise
        self._semaphore = wake_semaphore(segment, wiring.board)
        # Faults signal this process. From another PID namespace they would strike another one.
        self.block[Block.PID] = os.getpid() if segment.launcher else 0
        self.block[Block.WAITS_UNTIL] = 0
        self.block[Block.STATE] = TaskState.RUNNING

    def connect(self, program: HostProgram) -> None:
        """Put what reads and sends into the ports of the board's program."""
        ports = vars(program)
        for port, mailbox in self._wiring.inputs.items():
            self._segment.message_classes[mailbox] = program.inputs[port].message
            ports[port] = BusReceiver(DoubleBufferReader(self._segment, mailbox))
        for port, writer in self._writers.items():
            ports[port] = BusSender(self, writer, program.outputs[port].message)

    @property
    def tick(self) -> int:
        """The clock's tick; of a paced program that of the cycle in which it runs."""
        return self.block[Block.RELEASED] if self._is_paced else self._words[System.TICK]

    @property
    def time_s(self) -> float:
        """Time since some moment, s: of a paced program simulated time."""
        return self.tick * self._wiring.context.tick_s if self._is_paced else time.monotonic()

    @property
    def is_over(self) -> bool:
        """Whether the run has ended: the program should return."""
        return self._segment.run_is_over

    def wait(self, timeout_s: float) -> bool:
        """Wait until a message arrives; False when none has after the timeout, or when the run
        ends.
        """
        if self._is_paced:
            ticks = round(min(timeout_s, LONGEST_S) / self._wiring.context.tick_s)
            self.block[Block.WAITS_UNTIL] = self.tick + max(1, ticks)
            self._end_turn()
            self.await_turn()
            return not self.block[Block.WAITS_UNTIL]
        deadline = time.monotonic() + timeout_s
        while not self.is_over:
            left = deadline - time.monotonic()
            if self._semaphore.acquire(max(0.0, min(left, CHECK_S))):
                return True
            if left <= CHECK_S:
                return False
        return False

    def await_turn(self) -> None:
        """Wait until the program may run, or the run ends. In real time it always may."""
        block = self.block
        # The clock admits the successor of a lost process. Read first: it clears this word last.
        while (
            self._is_paced
            and (block[Block.LOST] or block[Block.DONE] == block[Block.RELEASED])
            and not self.is_over
        ):
            self._semaphore.acquire(CHECK_S)

    def _end_turn(self) -> None:
        """Let the adapter go on."""
        block = self.block
        block[Block.DEADLINE] = self.tick + self._wiring.computing
        block[Block.DONE] = block[Block.RELEASED]
        done_semaphore(self._segment, self._wiring.board).release()

    @property
    def tasks(self) -> list[str]:
        """Names of the crate's tasks."""
        return [task.name for task in self._segment.layout.tasks]

    def address(self, name: str) -> int:
        """Return the bus address of a mailbox, or of the control block of a task. Raises
        `LookupError`.
        """
        places = self._segment.map
        found = {**places.blocks, **places.mailboxes}
        if name not in found:
            raise LookupError(f"nothing on the bus is called '{name}'; known: {', '.join(found)}")
        return found[name]

    def words(self, address: int, count: int = 1) -> list[int]:
        """Return words of the crate's memory from a bus address on. Raises `ValueError` for an
        address without one.
        """
        size = self._segment.map.size
        last = address + WORD * count
        if address % WORD or not 0 <= address < last <= size:
            raise ValueError(
                f"words of {WORD} bytes at 0x{address:06x} to 0x{last:06x}: the bus has 0 to"
                f" 0x{size:06x}"
            )
        return list(self._words[address // WORD : last // WORD])

    def finish(self) -> None:
        """Declare the program's work done, as its return does."""
        self.block[Block.STATE] = TaskState.ENDED
        if self._is_paced:
            self._end_turn()

    def close(self) -> None:
        """Give the board up: another process may open it."""
        for writer in self._writers.values():
            writer.close()
        self._claim.close()


def _claim(segment: Segment, board: str) -> ByteLock:
    claim = ByteLock(segment.fd, segment.map.blocks[board] + WORD * Block.PID)
    if not claim.take():
        claim.close()
        pid = segment.launcher and segment.block(board)[Block.PID]
        where = f" (process {pid})" if pid else " in another PID namespace"
        raise MailboxError(f"host board '{board}' is already running{where}")
    return claim
