"""The ends of what `rack bench lan` compares: how a process of one machine exchanges messages with
those of others.

Machine 0 is the coordinator, as in a cell: it sends an order to every other machine, and each of
these sends it a status. Among themselves they exchange nothing.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

COORDINATOR = 0
ORDER_BYTES = 1024
STATUS_BYTES = 256
PORT = 7447
LEASE_MS = 200
UNREAD = 32
"""Messages of one machine that wait for a cycle, at most."""

Take = Callable[[int, bytes], None]
"""Takes a message: from which machine it is, its content."""
Notice = Callable[[int, bool], None]
"""Takes a change: which machine, whether it is there now or gone."""


@dataclass(frozen=True)
class LanTask:
    """What the process of `machine` is to do, and the addresses of all. `certificates`: a folder;
    empty: without TLS. `echoes`: answer, or count answers, at once; else take messages in
    cycles."""

    who: str
    machine: int
    addresses: tuple[str, ...]
    certificates: str
    echoes: bool
    priority: int

    @property
    def is_coordinator(self) -> bool:
        """Whether this is the machine that exchanges messages with all others."""
        return self.machine == COORDINATOR

    @property
    def others(self) -> tuple[int, ...]:
        """The machines that this one exchanges messages with."""
        return tuple(range(1, len(self.addresses))) if self.is_coordinator else (COORDINATOR,)


def rack_name(machine: int) -> str:
    """Return the name of the rack on a machine."""
    return f"r{machine}"


class End(Protocol):
    """One end, open. Given `take`, it passes every message on at once, in a thread of its own; else
    a cycle takes them.

    `notice` is called in a thread, too.
    """

    def __init__(self, task: LanTask, notice: Notice, take: Take | None) -> None: ...

    def send(self, to: int, content: bytes) -> None:
        """Send a message to a machine, without waiting."""

    def taken(self) -> Iterator[tuple[int, bytes]]:
        """Yield what has come since the last call: from which machine, and the content."""


class UdpEnd:
    """A bare UDP socket: no connection, no seal, and nobody notices who is there."""

    def __init__(self, task: LanTask, notice: Notice, take: Take | None) -> None:
        self._places = {other: (task.addresses[other], PORT) for other in task.others}
        self._from = {address: other for other, (address, _) in self._places.items()}
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.bind((task.addresses[task.machine], PORT))
        self._take = take
        if take is None:
            self._socket.setblocking(False)
        else:
            threading.Thread(target=self._listen, daemon=True).start()
        for other in task.others:
            notice(other, True)

    def _listen(self) -> None:
        assert self._take is not None
        while True:
            content, (address, _) = self._socket.recvfrom(ORDER_BYTES)
            self._take(self._from[address], content)

    def send(self, to: int, content: bytes) -> None:
        """Send a message to a machine."""
        self._socket.sendto(content, self._places[to])

    def taken(self) -> Iterator[tuple[int, bytes]]:
        """Yield what has come since the last call."""
        with suppress(BlockingIOError):
            for _ in range(UNREAD * len(self._from)):
                content, (address, _) = self._socket.recvfrom(ORDER_BYTES)
                yield self._from[address], content
