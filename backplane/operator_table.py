"""Table of commands from outside the rack, in the system controller's shared-memory window.

Any process may add a request for a command at any time. Only the clock issues commands, at the
beginning of a tick: it publishes the message in the level's mailbox, of which it is the only
writer. All tasks of a tick therefore see the same commands, and a lockstep run repeats with the
same commands. This module treats a command as the bytes of a message; `levels` defines the meaning.

A request belongs either to the run or to a client, the process that added it and waits for it. A
client's request is dropped when the client's process ends, even if it is killed. To show that it is
alive, the client holds a kernel lock, which the clock can check in a microsecond. A client may also
ask for a lease: it then holds the lock after its command was issued and sends heartbeats, and if
either stops, the clock makes the level hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from enum import IntEnum

from rack.backplane.address_map import (
    OPERATOR_ENTRIES,
    OPERATOR_HEAD_SIZE,
    compute_operator_entry_size,
)
from rack.backplane.byte_lock import ByteLock, hold_lock
from rack.backplane.errors import OperatorTableError
from rack.backplane.segment import Segment
from rack.backplane.words import System, Word

_CLAIMS = 1 << 40
"""Address of the byte that the client of ticket 0 locks.

It lies beyond the end of any segment. This is possible because a lock needs no memory.
"""


class RequestStage(IntEnum):
    """Values of `RequestEntry.stage`."""

    FREE = 0
    WAITING = 1  # for its tick
    GIVEN = 2  # issued; the entry may be filled again


class Client(IntEnum):
    """Values of `RequestEntry.client`."""

    NONE = 0  # issued whether or not the process that added it is alive
    WAITS = 1  # issued only if its client is alive
    LEASES = 2  # the same; once issued, the level holds if the client ends or sends no heartbeats


@dataclass(frozen=True)
class Request:
    """Command to be issued.

    Attributes:
        mailbox: Index of the mailbox.
        message: Bytes of the message.
        tick: Tick at which it is issued, -1 for as soon as possible.
    """

    mailbox: int
    message: bytes
    tick: int = -1


class RequestEntry:
    """Entry of the operator table. `words` and `message` are views of shared memory.

    The process that adds a request fills the entry. After that, the clock writes `stage`, `serial`
    and `given_tick`, and a client writes `heard`.
    """

    stage = Word(0)  # RequestStage
    ticket = Word(1)  # number of the request: it changes when the entry is filled again
    mailbox = Word(2)  # index among the layout's mailboxes
    tick = Word(3)  # tick at which to issue it, -1 for at once
    # Serial of the command, which rises over all levels in the order of issue. 0 before.
    serial = Word(4)
    given_tick = Word(5)  # tick at which it was issued, -1 before
    client = Word(6)  # Client
    heard = Word(7)  # tick of the last heartbeat from the client of a lease, -1 before

    def __init__(self, segment: Segment, index: int) -> None:
        size = compute_operator_entry_size(segment.layout)
        address = segment.map.operator + index * size
        self.index = index
        self.words = segment.words[address // 8 : (address + OPERATOR_HEAD_SIZE) // 8]
        self.message = segment.get_bytes(address + OPERATOR_HEAD_SIZE, size - OPERATOR_HEAD_SIZE)

    @property
    def is_leased(self) -> bool:
        """True if the command was issued under a lease that has not been released."""
        return self.client == Client.LEASES and self.stage == RequestStage.GIVEN


class OperatorTable:
    """Operator table of one rack. `entries` contains all entries, including free ones."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = segment.words
        self.entries = [RequestEntry(segment, index) for index in range(OPERATOR_ENTRIES)]

    def add_request(self, request: Request) -> RequestEntry:
        """Add a request without a client. The clock issues its command at the requested tick.

        If no entry is free, the entry of the command that was issued longest ago is reused.

        Raises:
            OperatorTableError: Every entry waits for its tick or is leased.
        """
        with hold_lock(self._segment.fd, self._segment.map.operator):
            return self._fill_entry(request, Client.NONE)

    @contextmanager
    def claim_request(
        self, request: Request, client: Client = Client.WAITS
    ) -> Iterator[RequestEntry]:
        """Add a request whose client is this process, for the duration of a `with` block.

        At the end of the block, the request is withdrawn if it has not been issued.

        Args:
            request: Command to be issued.
            client: `Client.LEASES` to make the level hold when this process ends or is silent.

        Raises:
            OperatorTableError: Every entry waits for its tick or is leased.
        """
        with ExitStack() as stack:
            with hold_lock(self._segment.fd, self._segment.map.operator):
                ticket = self._words[System.REQUESTED] + 1
                # This lock shows that the client is alive while the request waits.
                lock = stack.enter_context(closing(ByteLock(self._segment.fd, _CLAIMS + ticket)))
                lock.take()
                entry = self._fill_entry(request, client)
            stack.callback(self.withdraw_request, entry, ticket)
            yield entry

    def withdraw_request(self, entry: RequestEntry, ticket: int) -> bool:
        """Withdraw a request that is still waiting.

        Args:
            entry: Entry of the request.
            ticket: Number of the request, in case the entry has been reused.

        Returns:
            False if the request is no longer waiting or is being issued at this moment.
        """
        if entry.ticket != ticket or entry.stage != RequestStage.WAITING:
            return False
        entry.stage = RequestStage.FREE
        # The clock does this in the opposite order: it first sets `given_tick`, then reads `stage`.
        return entry.given_tick < 0

    def is_waiting(self, entry: RequestEntry) -> bool:
        """Check that a request is still waiting, and that its client, if any, is alive."""
        if entry.stage != RequestStage.WAITING:
            return False
        return not entry.client or self.is_client_alive(entry)

    def is_client_alive(self, entry: RequestEntry) -> bool:
        """Check whether the client of a request is alive and so holds the request's lock."""
        return self._segment.is_locked(_CLAIMS + entry.ticket)

    def list_leased(self) -> list[RequestEntry]:
        """Return the requests that were issued under a lease that has not been released."""
        return [entry for entry in self.entries if entry.is_leased]

    def record_heartbeat(self, entry: RequestEntry, ticket: int) -> bool:
        """Record a heartbeat from the client of a lease.

        Args:
            entry: Entry of the request.
            ticket: Number of the request, in case the entry has been reused.

        Returns:
            False if the lease has been released.
        """
        entry.heard = self._words[System.TICK]
        return entry.ticket == ticket and entry.client == Client.LEASES

    def release_lease(self, entry: RequestEntry) -> None:
        """Release the lease of a request. The level then continues even if the client ends."""
        entry.client = Client.WAITS

    def list_waiting(self) -> list[RequestEntry]:
        """Return the waiting requests in the order in which they were added."""
        return sorted(filter(self.is_waiting, self.entries), key=lambda entry: entry.ticket)

    def find_missing(self, requests: Sequence[Request]) -> list[Request]:
        """Return the commands of a recorded run for which no request waits in the table.

        Args:
            requests: Commands of the run in the order of issue. `tick` is the tick at which the
                command was issued, which may be later than the requested tick.
        """
        waiting = sorted(self.list_waiting(), key=lambda entry: entry.tick)
        missing = []
        for request in requests:
            message = request.message
            entry = next(
                (
                    entry
                    for entry in waiting
                    if entry.mailbox == request.mailbox
                    and entry.tick <= request.tick
                    and entry.message[: len(message)] == message
                ),
                None,
            )
            if entry is None:
                missing.append(request)
            else:
                waiting.remove(entry)
        return missing

    def _fill_entry(self, request: Request, client: Client) -> RequestEntry:
        """Fill a free or reusable entry with a request. The caller must hold the table's lock.

        Raises:
            OperatorTableError: Every entry waits for its tick or is leased.
        """
        settled = [e for e in self.entries if not self.is_waiting(e) and not e.is_leased]
        if not settled:
            raise OperatorTableError(
                f"the operator table is full: {len(self.entries)} commands wait for their ticks;"
                " try again once one of them has been issued"
            )
        entry = min(settled, key=lambda e: (e.stage, e.serial))
        entry.stage = RequestStage.FREE
        entry.ticket = self._words[System.REQUESTED] + 1
        entry.client = client
        entry.mailbox = request.mailbox
        entry.tick = request.tick
        entry.serial = 0
        entry.given_tick = -1
        entry.heard = -1
        entry.message[: len(request.message)] = request.message
        # Store the stage last, because the clock may then issue the command.
        entry.stage = RequestStage.WAITING
        self._words[System.REQUESTED] += 1
        return entry
