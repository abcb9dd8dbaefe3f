"""The operator table: commands from outside, in shared memory, in the system controller's window.

Any process may add a request, at any time. Only the clock issues it, at the beginning of a tick: it
publishes the message in the level's mailbox, whose only writer it is. All tasks of a tick therefore
see the same commands, and a run in lockstep repeats with them. Here a command is only the bytes of
a message; `levels` defines its meaning.

A request belongs to the run, or to a client that waits for it. The latter is withdrawn when the
client's process ends, even if it is killed: the client holds a kernel lock, which the clock can
check in a microsecond. With a lease the client stays after its command was issued, and the clock
sees when it ends, or is not `heard` any more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from rack.backplane.address_map import OPERATOR_ENTRIES, OPERATOR_HEAD_SIZE, operator_entry_size
from rack.backplane.byte_lock import ByteLock
from rack.backplane.checked import as_named
from rack.backplane.errors import OperatorTableError
from rack.backplane.segment import Segment
from rack.backplane.words import System

_CLAIMS = 1 << 40
"""Address of the byte that the client of ticket 0 locks: beyond any segment, since a lock needs no
memory."""


class RequestStage(IntEnum):
    """Values of `RequestWord.STAGE`."""

    FREE = 0
    WAITING = 1  # for its tick
    GIVEN = 2  # issued; the entry may be filled again


class Client(IntEnum):
    """Values of `RequestWord.CLIENT`."""

    NONE = 0  # the request belongs to the run
    WAITS = 1  # issued only while its client lives
    LEASES = 2  # the same, and in force only while its client lives


class RequestWord:
    """Words of an entry. The host fills a free one; from then on the clock writes STAGE, SERIAL and
    GIVEN_TICK."""

    STAGE = 0
    TICKET = 1  # number of the request: it changes when the entry is filled again
    MAILBOX = 2  # index among the layout's mailboxes
    TICK = 3  # tick at which to issue it; -1: at once
    SERIAL = 4  # of the command, rising over all levels in the order of issue; 0: not yet
    GIVEN_TICK = 5  # -1: not yet
    CLIENT = 6
    HEARD = 7  # tick at which the client of a lease was last heard


@dataclass(frozen=True)
class Request:
    """A command to issue: the index of its mailbox, its message, and its tick (-1: as soon as
    possible)."""

    mailbox: int
    message: bytes
    tick: int = -1


class RequestEntry:
    """One entry of the table: `words` and `message` are views of shared memory."""

    def __init__(self, segment: Segment, index: int) -> None:
        size = operator_entry_size(segment.layout)
        address = segment.map.operator + index * size
        self.index = index
        self.words = segment.words[address // 8 : (address + OPERATOR_HEAD_SIZE) // 8]
        self.message = segment.view(address + OPERATOR_HEAD_SIZE, size - OPERATOR_HEAD_SIZE)

    def __getitem__(self, word: int) -> int:
        """Return a word of the entry."""
        return self.words[word]

    @property
    def stage(self) -> RequestStage:
        """Stage of the request."""
        return as_named(RequestStage, self.words[RequestWord.STAGE])

    def becomes(self, issued: Request) -> bool:
        """Say whether this request may be the one that was issued so."""
        return (
            self.words[RequestWord.MAILBOX] == issued.mailbox
            and self.words[RequestWord.TICK] <= issued.tick
            and self.message[: len(issued.message)] == issued.message
        )


class RequestClaim(NamedTuple):
    """A request that its client has added. While it waits, its `lock` shows that the client
    lives."""

    entry: RequestEntry
    ticket: int
    lock: ByteLock

    def leave(self) -> None:
        """Be its client no more."""
        self.lock.close()


class OperatorTable:
    """The table of one rack. `entries` holds all entries, free ones too."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._words = segment.words
        self.entries = [RequestEntry(segment, index) for index in range(OPERATOR_ENTRIES)]

    def add(self, request: Request) -> RequestEntry:
        """Fill a free entry, or that of the command issued longest ago; the clock issues it when it
        is due.

        Raises `OperatorTableError` when all entries wait for their ticks.
        """
        claim = self._await_turn(request, Client.NONE)
        claim.leave()
        return claim.entry

    @contextmanager
    def claim(self, request: Request, client: Client = Client.WAITS) -> Iterator[RequestEntry]:
        """Add a request as its client, and withdraw it at the end of the `with` block unless it has
        been issued.

        Raises `OperatorTableError` when all entries wait for their ticks.
        """
        claim = self._await_turn(request, client)
        try:
            yield claim.entry
        finally:
            self.withdraw(claim.entry, claim.ticket)
            claim.leave()

    def _await_turn(self, request: Request, client: Client) -> RequestClaim:
        # Bounded by the time in which another process fills an entry.
        while (claim := self.try_claim(request, client)) is None:
            continue
        return claim

    def try_claim(self, request: Request, client: Client = Client.WAITS) -> RequestClaim | None:
        """Add a request without waiting; None while another process fills an entry, and might be
        preempted meanwhile.

        Raises `OperatorTableError` when all entries wait for their ticks.
        """
        lock = ByteLock(self._segment.fd, self._segment.map.operator)
        try:
            return self._add(request, client) if lock.take() else None
        finally:
            lock.close()

    def _add(self, request: Request, client: Client) -> RequestClaim:
        leased = self.leased()
        settled = [e for e in self.entries if not self.is_waiting(e) and e not in leased]
        if not settled:
            why = f"{len(self.entries)} commands wait for their ticks"
            raise OperatorTableError(
                f"the operator table is full: {why}; permitted: once one of them is given"
            )
        entry = min(settled, key=lambda e: (e.stage, e[RequestWord.SERIAL]))
        ticket = self._words[System.REQUESTED] + 1
        lock = ByteLock(self._segment.fd, _CLAIMS + ticket)
        if client:
            lock.take()
        self._fill(entry, request, ticket, client)
        return RequestClaim(entry, ticket, lock)

    def withdraw(self, entry: RequestEntry, ticket: int) -> bool:
        """Withdraw a request that still waits; False when it was issued."""
        words = entry.words
        if words[RequestWord.TICKET] != ticket or words[RequestWord.STAGE] != RequestStage.WAITING:
            return False
        words[RequestWord.STAGE] = RequestStage.FREE
        # The clock first marks the request as issued, then checks whether it is still wanted.
        return words[RequestWord.GIVEN_TICK] < 0

    def is_waiting(self, entry: RequestEntry) -> bool:
        """Say whether a request waits, and its client, if any, still lives."""
        words = entry.words
        if words[RequestWord.STAGE] != RequestStage.WAITING:
            return False
        return not words[RequestWord.CLIENT] or self.client_lives(entry)

    def client_lives(self, entry: RequestEntry) -> bool:
        """Say whether the client of a request lives."""
        return self._segment.is_locked(_CLAIMS + entry.words[RequestWord.TICKET])

    def leased(self) -> list[RequestEntry]:
        """Return the requests that were issued under a lease, until it is released."""
        return [
            entry
            for entry in self.entries
            if entry[RequestWord.CLIENT] == Client.LEASES
            and entry[RequestWord.STAGE] == RequestStage.GIVEN
        ]

    def hear(self, entry: RequestEntry, ticket: int) -> bool:
        """Note that the client of a lease is there; False when the lease was released."""
        entry.words[RequestWord.HEARD] = self._words[System.TICK]
        words = entry.words
        return words[RequestWord.TICKET] == ticket and words[RequestWord.CLIENT] == Client.LEASES

    def release(self, entry: RequestEntry) -> None:
        """End the lease of a request: what happens to its client does not matter any more."""
        entry.words[RequestWord.CLIENT] = Client.WAITS

    def waiting(self) -> list[RequestEntry]:
        """Return the waiting requests in the order in which they were added."""
        found = [entry for entry in self.entries if self.is_waiting(entry)]
        return sorted(found, key=lambda entry: entry.words[RequestWord.TICKET])

    def lacking(self, requests: Sequence[Request]) -> list[Request]:
        """Return those of a run's commands, given in the order of issue, that do not wait here
        already: each entry is issued at its tick or, added late, after it."""
        waiting = sorted(self.waiting(), key=lambda entry: entry[RequestWord.TICK])
        found = []
        for wanted in requests:
            entry = next((entry for entry in waiting if entry.becomes(wanted)), None)
            if entry is None:
                found.append(wanted)
            else:
                waiting.remove(entry)
        return found

    def _fill(self, entry: RequestEntry, request: Request, ticket: int, client: Client) -> None:
        words = entry.words
        words[RequestWord.STAGE] = RequestStage.FREE
        words[RequestWord.TICKET] = ticket
        words[RequestWord.CLIENT] = client
        words[RequestWord.MAILBOX] = request.mailbox
        words[RequestWord.TICK] = request.tick
        words[RequestWord.SERIAL] = 0
        words[RequestWord.GIVEN_TICK] = -1
        words[RequestWord.HEARD] = -1
        entry.message[: len(request.message)] = request.message
        # From here the clock may issue it.
        words[RequestWord.STAGE] = RequestStage.WAITING
        self._words[System.REQUESTED] += 1
