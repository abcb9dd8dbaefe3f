"""Questions to a rack from another machine, and their answers, as bytes.

A question is a query under the key `question_key`. Its envelope carries the version of the
segment's layout as `kind`, a number of the asker's session as `launch`, the number of the question
in it as `serial`, and as `number` that of the question that it repeats, or its own: an answer may
be lost. The answer's envelope carries session and number back, as `number` and `serial`: it cannot
be passed off as that to another question.

A reader maps a window of another rack's memory into its own, as a bus adapter does: it asks for
stretches of the segment, and finds out by itself what lies there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from struct import Struct
from struct import error as Unpackable  # noqa: N812
from typing import Literal, NamedTuple

from rack.backplane.operator_table import Request
from rack.boards.lan.config import Right
from rack.boards.lan.keys import ASKED

What = Literal["stop", "reset", "give", "lease", "withdraw", "read"]
NEEDED: Mapping[What, Right] = {
    "stop": "stop",
    "reset": "stop",
    "give": "command",
    "lease": "command",
    "withdraw": "command",
    "read": "watch",
}
"""The right that each question needs. Nobody may reset an emergency stop from afar."""
MOST_STRETCHES = 256
"""Stretches of memory in one question."""
MOST_CONTENT = 65_000
"""Bytes of content in one answer."""
MOST_QUESTION = 1 << 13
"""Bytes of the longest question."""
_STRETCH = Struct("<QI")
_ANSWER = Struct("<qqqqQ")
_REQUEST = Struct("<Iq")
_TICKET = Struct("<IQ")


class Stretch(NamedTuple):
    """A part of a segment: bus address, and size in bytes."""

    address: int
    size: int


class Code(IntEnum):
    """What became of a question."""

    GRANTED = 0
    NOT_PERMITTED = 1
    OTHER_VERSION = 2  # of the segment's layout
    OUTSIDE = 3  # stretches outside the segment, or more than one answer holds
    NOT_VALID = 4  # no such command
    PAST = 5  # its tick has passed
    BUSY = 6  # another process is giving a command: ask again
    FULL = 7  # too many commands wait
    AT_THE_RACK = 8  # it is done there alone


class DeskAnswer(NamedTuple):
    """An answer: the tick at which it was made, both clocks of its machine, in ns, and its content.

    `hosts`: which host boards live, as bits in their order.
    """

    code: Code
    tick: int
    monotonic_ns: int
    realtime_ns: int
    hosts: int = 0
    content: bytes = b""

    def packed(self) -> bytes:
        """Return it as bytes."""
        return _ANSWER.pack(*self[:5]) + self.content

    @classmethod
    def unpacked(cls, packed: bytes) -> DeskAnswer | None:
        """Return an answer from its bytes; None if that is none."""
        try:
            code, tick, monotonic_ns, realtime_ns, hosts = _ANSWER.unpack_from(packed)
            return cls(Code(code), tick, monotonic_ns, realtime_ns, hosts, packed[_ANSWER.size :])
        except (Unpackable, ValueError):
            return None


def question_key(rack: str, what: What, asker: str) -> str:
    """Return the key expression of a question."""
    return f"rack/{rack}/ask/{ASKED[NEEDED[what]]}/{asker}/{what}"


def answer_key(question: str) -> str:
    """Return the key under which the answer to a question is sealed: no question passes for an
    answer."""
    return f"{question}/answer"


def packed_stretches(stretches: Sequence[Stretch]) -> bytes:
    """Return the question for stretches of a segment."""
    return b"".join(_STRETCH.pack(*stretch) for stretch in stretches)


def unpacked_stretches(packed: bytes, end: int) -> list[Stretch] | None:
    """Return the stretches of a question; None if one is outside a segment of `end` bytes, or they
    are too many."""
    if len(packed) % _STRETCH.size or len(packed) > MOST_STRETCHES * _STRETCH.size:
        return None
    found = [Stretch(*pair) for pair in _STRETCH.iter_unpack(packed)]
    fits = all(stretch.address + stretch.size <= end for stretch in found)
    return found if fits and sum(stretch.size for stretch in found) <= MOST_CONTENT else None


def packed_request(request: Request) -> bytes:
    """Return the question that gives an operator's request, also under a lease."""
    return _REQUEST.pack(request.mailbox, request.tick) + request.message


def unpacked_request(packed: bytes) -> Request | None:
    """Return the request of a question; None if that is none."""
    if len(packed) <= _REQUEST.size:
        return None
    mailbox, tick = _REQUEST.unpack_from(packed)
    return Request(mailbox, packed[_REQUEST.size :], tick)


class Ticket(NamedTuple):
    """A request in the operator table: index of its entry, and its number."""

    entry: int
    number: int

    def packed(self) -> bytes:
        """Return it as bytes: the answer to a request, and the question that withdraws it."""
        return _TICKET.pack(*self)

    @classmethod
    def unpacked(cls, packed: bytes) -> Ticket | None:
        """Return a ticket from bytes; None if that is none."""
        return cls(*_TICKET.unpack(packed)) if len(packed) == _TICKET.size else None
