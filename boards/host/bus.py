"""The bus for programs of the host side: `rack.levels.host_program.Bus`, on a segment."""

from __future__ import annotations

import os
import time
from typing import Any

from rack.backplane.address_map import SCRATCH_SIZE
from rack.backplane.byte_lock import ByteLock
from rack.backplane.clock.wake import CHECK_S
from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.host_ring import HostWriter
from rack.backplane.mailbox.mailbox import DoubleBufferReader, Reading
from rack.backplane.message import COMMAND_ID, AnyMessage, Message
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore, get_wake_semaphore
from rack.backplane.words import Block, System, TaskState
from rack.boards.wiring import HostWiring
from rack.levels.host_program import HostProgram

WORD = 8
"""Size of a word on the backplane, in bytes."""
LONGEST_S = 1e9
"""Longest time-out of a paced program in s. Longer time-outs are reduced to it."""


class BusReceiver:
    """Input of a host program. See `HostReceiver`."""

    def __init__(self, reader: DoubleBufferReader) -> None:
        self._reader = reader

    def read(self) -> Reading[AnyMessage]:
        """Return the newest message, with the unread messages before it in `earlier`.

        In the first read, `earlier` is empty.
        """
        before = self._reader.serial
        reading = self._reader.peek()
        return self._reader.add_earlier(reading, before) if before else reading


class BusSender:
    """Output of a host program. See `HostSender`.

    Attributes:
        message: The message that the program fills and sends.
    """

    def __init__(self, bus: HostBus, writer: HostWriter, kind: type[Message]) -> None:
        self._bus = bus
        self._writer = writer
        # The message is stored in the writer's memory.
        self.message: Any = kind(writer.message.record.dtype, writer.message.raw)
        self._clear_message()

    def _clear_message(self) -> None:
        """Clear the message. If it has a field for an id, set it to the id of the next message."""
        self.message.clear()
        if COMMAND_ID in (self.message.record.dtype.names or ()):
            self.message.id = self.sent + 1

    def send(self) -> bool:
        """Send a copy of the message and clear it.

        Returns:
            False if the queue is full. The message is then neither sent nor cleared.
        """
        is_sent = self._writer.send_message(self._bus.tick)
        if is_sent:
            self._clear_message()
        return is_sent

    @property
    def sent(self) -> int:
        """Number of messages sent through this port, those of previous processes included."""
        return self._writer.serial


class HostBus:
    """Ports and clock of one host board. Creating it claims the board for this process.

    In lockstep a program is paced: it runs only in turns, during which its adapter waits. See
    `rack.boards.host.bus_adapter`.

    Args:
        segment: Segment of the rack.
        wiring: Wiring of the host board.

    Attributes:
        block: Control block of the host board.
        is_paced: Whether the program runs in turns, because the rack is in lockstep.

    Raises:
        MailboxError: Another process has claimed the board.
    """

    def __init__(self, segment: Segment, wiring: HostWiring) -> None:
        self._segment = segment
        self._words = segment.words
        self._wiring = wiring
        layout = segment.layout
        pacers = layout.find_pacers(layout.find_task(wiring.board))
        self.is_paced = bool(self._words[System.LOCKSTEP] and pacers)
        self.block = segment.get_block(wiring.board)
        self._claim = _claim_board(segment, wiring.board)
        self._writers: dict[str, HostWriter] = {}
        try:
            for port, mailbox in wiring.outputs.items():
                self._writers[port] = HostWriter(segment, mailbox)
        except MailboxError:
            self.close()
            raise
        self._semaphore = get_wake_semaphore(segment, wiring.board)
        # Faults send signals to this process id. If the program runs in another PID namespace, the
        # id could belong to another process, so it is not published.
        self.block[Block.PID] = os.getpid() if segment.launcher else 0
        self.block[Block.WAITS_UNTIL] = 0
        self.block[Block.STATE] = TaskState.RUNNING

    def connect_ports(self, program: HostProgram) -> None:
        """Set each input of a program to a `BusReceiver`, and each output to a `BusSender`."""
        ports = vars(program)
        for port, mailbox in self._wiring.inputs.items():
            self._segment.message_classes[mailbox] = program.inputs[port].message
            ports[port] = BusReceiver(DoubleBufferReader(self._segment, mailbox))
        for port, writer in self._writers.items():
            ports[port] = BusSender(self, writer, program.outputs[port].message)

    @property
    def tick(self) -> int:
        """Tick of the clock. For a paced program, the tick of the cycle in which it runs."""
        return self.block[Block.RELEASED] if self.is_paced else self._words[System.TICK]

    @property
    def time_s(self) -> float:
        """Monotonic time in s, with an arbitrary origin. Simulated time for a paced program."""
        return self.tick * self._wiring.context.tick_s if self.is_paced else time.monotonic()

    @property
    def is_over(self) -> bool:
        """Whether the run has ended, so that the program should return."""
        return self._segment.run_is_over

    def wait(self, timeout_s: float) -> bool:
        """Wait until a message arrives.

        Args:
            timeout_s: Longest time to wait in s. Simulated time for a paced program.

        Returns:
            True if a message has arrived. False after the time-out or at the end of the run.
        """
        if self.is_paced:
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
        """Wait for the turn of a paced program or the end of the run.

        Return at once if the program is not paced.
        """
        block = self.block
        # After a restart, the clock must first readmit the board. It clears LOST as its last step,
        # so LOST must be read first.
        while (
            self.is_paced
            and (block[Block.LOST] or block[Block.DONE] == block[Block.RELEASED])
            and not self.is_over
        ):
            self._semaphore.acquire(CHECK_S)

    def _end_turn(self) -> None:
        """End the program's turn, so that the adapter continues its cycle."""
        block = self.block
        block[Block.DEADLINE] = self.tick + self._wiring.computing
        block[Block.DONE] = block[Block.RELEASED]
        get_done_semaphore(self._segment, self._wiring.board).release()

    @property
    def tasks(self) -> list[str]:
        """Names of the rack's tasks."""
        return [task.name for task in self._segment.layout.tasks]

    def address(self, name: str) -> int:
        """Return the bus address of a mailbox, or of the control block of a task.

        Raises:
            LookupError: No mailbox and no task has this name.
        """
        places = self._segment.map
        known = {**places.blocks, **places.mailboxes}
        if name not in known:
            raise LookupError(f"nothing on the bus is called '{name}'; known: {', '.join(known)}")
        return known[name]

    def words(self, address: int, count: int = 1) -> list[int]:
        """Return the values of consecutive words on the backplane.

        Args:
            address: Bus address of the first word, a multiple of 8.
            count: Number of words.

        Raises:
            ValueError: The address is not a multiple of 8, or a word is not on the bus.
        """
        for number in (address, count):
            if not isinstance(number, int):
                raise ValueError(f"{number!r}: addresses and counts must be integers")
        size = self._segment.map.size
        last = address + WORD * count
        if address % WORD or not 0 <= address < last <= size:
            aligned = f"; addresses must be multiples of {WORD}" if address % WORD else ""
            raise ValueError(
                f"words of {WORD} bytes at 0x{address:06x} to 0x{last:06x}: the bus has 0 to"
                f" 0x{size:06x}{aligned}"
            )
        return list(self._words[address // WORD : last // WORD])

    @property
    def scratch(self) -> int:
        """Bus address of the first scratch word of this board."""
        return self._segment.map.scratch[self._wiring.board]

    def write(self, address: int, value: int) -> None:
        """Write one of the scratch words of this board.

        Args:
            address: Bus address of the word, a multiple of 8.
            value: The value, a signed 64-bit integer.

        Raises:
            ValueError: The address is invalid, the word is not a scratch word of this board, or the
                value is not a 64-bit integer.
        """
        self.words(address)
        first = self.scratch
        if not first <= address < first + SCRATCH_SIZE:
            raise ValueError(
                f"the word at 0x{address:06x} is read-only: it belongs to"
                f" {self._segment.map.describe_owner(address)}; '{self._wiring.board}' may write"
                f" 0x{first:06x} to 0x{first + SCRATCH_SIZE - WORD:06x}"
            )
        if not isinstance(value, int) or not -(1 << 63) <= value < 1 << 63:
            raise ValueError(f"{value!r}: must be a whole number from -2^63 to 2^63 - 1")
        self._words[address // WORD] = value

    def finish(self) -> None:
        """Record that the program is finished. The board calls this when `run` returns."""
        self.block[Block.STATE] = TaskState.ENDED
        if self.is_paced:
            self._end_turn()

    def close(self) -> None:
        """Release the claim, so that another process can open the board."""
        for writer in self._writers.values():
            writer.close()
        self._claim.close()


def _claim_board(segment: Segment, board: str) -> ByteLock:
    """Claim a host board. Raises `MailboxError` if another process has claimed it."""
    claim = ByteLock(segment.fd, segment.map.blocks[board] + WORD * Block.PID)
    if not claim.take():
        claim.close()
        pid = segment.launcher and segment.get_block(board)[Block.PID]
        where = f" (process {pid})" if pid else " in another PID namespace"
        raise MailboxError(f"host board '{board}' is already running{where}")
    return claim
