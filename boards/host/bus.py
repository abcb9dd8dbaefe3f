"""The bus as a program of the host side sees it: `rack.levels.host_program.Bus`, on a segment."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import Any, TypeVar

from rack.backplane.byte_lock import ByteLock
from rack.backplane.clock.wake import CHECK_S
from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.host_ring import HostWriter
from rack.backplane.mailbox.mailbox import DoubleBufferReader, Reading
from rack.backplane.message import COMMAND_ID
from rack.backplane.segment import Segment
from rack.backplane.semaphores import done_semaphore, wake_semaphore
from rack.backplane.words import Block, System, TaskState
from rack.boards.wiring import HostWiring

WORD = 8
LONGEST_S = 1e9
_Port = TypeVar("_Port")


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
        self._readers = {
            port: DoubleBufferReader(segment, mailbox) for port, mailbox in wiring.inputs.items()
        }
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
        ends."""
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

    def read(self, port: str) -> Reading[Any]:
        """Return the newest message; `earlier` holds the unread ones before it, as far as the
        mailbox keeps them; the first read returns the newest alone."""
        reader = _of(self._readers, port)
        before = reader.serial
        reading = reader.peek()
        return reader.with_earlier(reading, before) if before else reading

    def send(self, port: str, **fields: Any) -> bool:
        """Send a message with these fields, all others 0; False when too many wait at the adapter.

        A command without an `id` gets the number of the message, which rises by one with every
        message sent. Raises `AttributeError` for an unknown field.
        """
        writer = _of(self._writers, port)
        message = writer.message
        message.clear()
        if COMMAND_ID in (message.record.dtype.names or ()):
            message.id = writer.serial + 1
        for name, value in fields.items():
            # Read first: a slot for any other name would raise an error that does not list the
            # fields.
            getattr(message, name)
            setattr(message, name, value)
        return writer.send(self.tick)

    def sent(self, port: str) -> int:
        """Return the number of messages sent so far, by former processes of this board too."""
        return _of(self._writers, port).serial

    @property
    def tasks(self) -> list[str]:
        """Names of the crate's tasks."""
        return [task.name for task in self._segment.layout.tasks]

    def address(self, name: str) -> int:
        """Return the bus address of a mailbox, or of the control block of a task. Raises
        `LookupError`."""
        places = self._segment.map
        found = {**places.blocks, **places.mailboxes}
        if name not in found:
            raise LookupError(f"nothing on the bus is called '{name}'; known: {', '.join(found)}")
        return found[name]

    def words(self, address: int, count: int = 1) -> list[int]:
        """Return words of the crate's memory from a bus address on. Raises `ValueError` for an
        address without one."""
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


def _of(ports: Mapping[str, _Port], port: str) -> _Port:
    if port not in ports:
        raise AttributeError(f"no port '{port}'; ports: {', '.join(sorted(ports)) or 'none'}")
    return ports[port]
