"""The desk of a rack's network adapter: it answers questions from other machines, in the adapter's
cycles.

What others may ask is in `[adapter.lan.permit]`; the rest is refused. A question that is malformed,
unsigned or oversized gets no answer at all. Answers and bytes of a cycle are bounded, whatever
comes: what exceeds them waits, and in the end is overwritten by newer questions. The emergency stop
has a channel of its own, and comes first.

Commands go into the operator table, as those of an operator at the rack. A request waits there as
long as its client asks on: `CLIENT_S` after its last question, or at the end of this process, it is
withdrawn. Under a lease the desk is its client after it was issued, too, as long: then it is in
force no more, and its level holds.
"""

from __future__ import annotations

import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import OperatorTableError
from rack.backplane.lines import UtilityLines
from rack.backplane.mailbox.host_ring import ProperContent
from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import Message, fill_counts
from rack.backplane.operator_table import (
    Client,
    OperatorTable,
    Request,
    RequestClaim,
    RequestStage,
    RequestWord,
)
from rack.backplane.rack_name import RACK_NAME
from rack.backplane.segment import VERSION, Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block, System
from rack.boards.lan.config import Right
from rack.boards.lan.envelope import Envelope, Flaw, Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import ASKED
from rack.boards.lan.link import LanLink, Question
from rack.boards.lan.questions import (
    MOST_CONTENT,
    MOST_QUESTION,
    NEEDED,
    Code,
    DeskAnswer,
    Ticket,
    answer_key,
    unpacked_request,
    unpacked_stretches,
)
from rack.levels.level import Finding

QUESTIONS_A_CYCLE = 16
"""Questions of each right that a cycle looks at."""
ANSWERS_A_CYCLE = 4
"""Answers of each right that a cycle sends."""
BYTES_A_CYCLE = MOST_CONTENT
"""Bytes of content after which a cycle answers no further question to read."""
CLIENT_S = 2.0
"""Real time without a question of a client after which it counts as gone."""
WATCHED_S = 1.0
LINGER_S = 0.3
PAUSE_S = 0.005
"""At the end of a run: time since the last look from which nobody watches any more, how long those
who do may still look, and how often the desk then has a cycle; real time."""
STALE_S = 0.5
"""How much longer than its ticks a cycle may take, real time, before commands that came meanwhile
are dropped."""
REMEMBERED = 64
"""Commands of which the desk remembers that it gave them, in case they are asked for again."""
MOST_CLIENTS = 16
"""Requests that wait for clients of this desk, at most."""
_ASKER = re.compile(RACK_NAME)


@dataclass
class DeskCount:
    """Questions so far: see `rack.boards.lan.messages.DESK`."""

    answered: int = 0
    refused: int = 0
    dropped: int = 0


class Permit(NamedTuple):
    """Who may ask what, and the names of which findings give the number."""

    rights: Mapping[str, Sequence[Right]]
    names: Sequence[str]


class Asked(NamedTuple):
    """A good question: who asks, with which right, what, and its envelope."""

    asker: str
    what: str
    head: Envelope
    question: Question


@dataclass
class Waiting:
    """A request in the operator table, of a client's session, and until when that counts as there,
    CLOCK_MONOTONIC."""

    session: tuple[str, int]
    claim: RequestClaim
    until_ns: int

    @property
    def waits(self) -> bool:
        """Whether it has not been issued yet."""
        entry = self.claim.entry
        return (
            entry[RequestWord.TICKET] == self.claim.ticket and entry.stage == RequestStage.WAITING
        )


class Desk:
    """Answers the questions to one rack. An emergency stop from another machine is one of its
    `findings`."""

    def __init__(
        self, segment: Segment, grid: OwnGrid, permit: Permit, findings: list[Finding]
    ) -> None:
        self._segment = segment
        self._grid = grid
        self._findings = findings
        self._permit, self._names = permit
        self._lines = UtilityLines(segment)
        self._table = OperatorTable(segment)
        boxes = enumerate(segment.layout.mailboxes)
        self._boxes = {
            at: box for at, box in boxes if box.writer == CLOCK and box.name.endswith(".operator")
        }
        self._hosts = [
            segment.map.blocks[host.name] + 8 * Block.PID for host in segment.layout.hosts
        ]
        self._channels: dict[Right, Callable[[], Iterator[Question]]] = {}
        self._waiting: list[Waiting] = []
        self._given: deque[tuple[tuple[str, int, int], Ticket]] = deque(maxlen=REMEMBERED)
        self.count = DeskCount()
        self._sent = self._tick = self._watched_ns = self._cycled_ns = 0
        self._sealer: Sealer
        self._launch = 0

    def open(self, link: LanLink, launch: int) -> None:
        """Take questions from now on."""
        self._sealer = link.sealer
        self._launch = launch
        rights: tuple[Right, ...] = ("stop", "command", "watch")
        self._channels = {
            right: link.answer(f"rack/{link.rack}/ask/{ASKED[right]}/*/*") for right in rights
        }

    def answer(self, tick: int) -> None:
        """Answer the questions that have come, within the bounds of a cycle."""
        self._drop_stale(tick)
        self._sent = 0
        self._tick = tick
        for right, channel in self._channels.items():
            answers = 0
            for question in islice(channel(), QUESTIONS_A_CYCLE):
                asked = self._checked(question, right)
                if asked is None:
                    self.count.dropped += 1
                    continue
                self._reply(asked, self._answered(asked, right, tick), tick)
                answers += 1
                if answers == ANSWERS_A_CYCLE or self._sent >= BYTES_A_CYCLE:
                    break
        if self._waiting:
            self._dismiss()

    def _drop_stale(self, tick: int) -> None:
        """Drop commands that waited while the rack was held: who gave them may have gone, or asks
        again."""
        now = time.monotonic_ns()
        ticks = tick - self._tick
        if now - self._cycled_ns > STALE_S * 1e9 + ticks * self._segment.words[System.PERIOD_NS]:
            self.count.dropped += sum(1 for _ in self._channels.get("command", lambda: ())())
        self._cycled_ns = now

    def close(self) -> None:
        """Let those who watch see the end of the run, which their last look was too early for."""
        now = time.monotonic_ns()
        if now - self._watched_ns > WATCHED_S * 1e9:
            return
        self._channels = {"watch": self._channels["watch"]}
        while time.monotonic_ns() - now < LINGER_S * 1e9:
            self.answer(self._tick)
            time.sleep(PAUSE_S)

    def resume(self, record: Any) -> None:
        """Count on from the group of its predecessor's last status."""
        self.count = DeskCount(*record.tolist())

    def fill(self, record: object) -> None:
        """Write its counts into the group of a status; in lockstep none, since they do not depend
        on ticks alone."""
        if not self._grid.is_lockstep:
            fill_counts(record, vars(self.count).values())

    def _checked(self, question: Question, right: Right) -> Asked | None:
        """Return a question with its parts; None if it is malformed, unsigned or oversized."""
        if len(question.payload) > MOST_QUESTION:
            return None
        head = self._sealer.opened(question.key, question.envelope, question.payload)
        if isinstance(head, Flaw):
            return None
        # A key has as many parts as the one that is subscribed to.
        *_, asker, what = question.key.split("/")
        is_proper = _ASKER.fullmatch(asker) and what in NEEDED and NEEDED[what] == right  # type: ignore[index]
        return Asked(asker, what, head, question) if is_proper else None

    def _answered(self, asked: Asked, right: Right, tick: int) -> tuple[Code, bytes]:
        if right not in self._permit.get(asked.asker, ()):
            return Code.NOT_PERMITTED, b""
        if asked.head.kind != VERSION:
            return Code.OTHER_VERSION, b""
        for waiting in self._waiting:
            if waiting.session == (asked.asker, asked.head.launch):
                waiting.until_ns = self._until_ns()
        match asked.what:
            case "stop":
                return self._stop(asked.asker)
            case "reset":
                return Code.AT_THE_RACK, b""
            case "give":
                return self._give(asked, tick, Client.WAITS)
            case "lease":
                return self._give(asked, tick, Client.LEASES)
            case "withdraw":
                return self._withdraw(asked)
        return self._read(asked.question.payload)

    def _reply(self, asked: Asked, answer: tuple[Code, bytes], tick: int) -> None:
        code, content = answer
        is_granted = code is Code.GRANTED
        self.count.answered += is_granted
        self.count.refused += not is_granted
        self._sent += len(content)
        hosts = sum(
            self._segment.is_locked(address) << at for at, address in enumerate(self._hosts[:64])
        )
        payload = DeskAnswer(
            code, tick, time.monotonic_ns(), time.time_ns(), hosts, content
        ).packed()
        head = asked.head
        grid = self._grid
        stamped = Envelope(
            VERSION,
            self._launch,
            head.serial,
            head.launch,
            tick,
            grid.time_ns(tick),
            grid.stamp_ns(tick),
        )
        asked.question.reply(
            payload, self._sealer.seal(answer_key(asked.question.key), stamped, payload)
        )

    def _stop(self, asker: str) -> tuple[Code, bytes]:
        if not self._lines.emergency_stop:
            self._findings.append(Finding(Alarm.REMOTE_STOP, self._names.index(asker)))
        self._lines.latch_emergency_stop()
        return Code.GRANTED, b""

    def _read(self, payload: bytes) -> tuple[Code, bytes]:
        memory = self._segment.bytes
        self._watched_ns = time.monotonic_ns()
        stretches = unpacked_stretches(payload, len(memory))
        if stretches is None:
            return Code.OUTSIDE, b""
        return Code.GRANTED, b"".join([memory[at : at + size] for at, size in stretches])

    def _give(self, asked: Asked, tick: int, client: Client) -> tuple[Code, bytes]:
        number = asked.asker, asked.head.launch, asked.head.number
        if (ticket := dict(self._given).get(number)) is not None:
            return Code.GRANTED, ticket.packed()
        request = unpacked_request(asked.question.payload)
        if request is None or not self._is_proper(request):
            return Code.NOT_VALID, b""
        if 0 <= request.tick <= tick:
            return Code.PAST, b""
        if len(self._waiting) == MOST_CLIENTS:
            return Code.FULL, b""
        try:
            claim = self._table.try_claim(request, client)
        except OperatorTableError:
            return Code.FULL, b""
        if claim is None:
            return Code.BUSY, b""
        self._waiting.append(Waiting((asked.asker, asked.head.launch), claim, self._until_ns()))
        ticket = Ticket(claim.entry.index, claim.ticket)
        self._given.append((number, ticket))
        return Code.GRANTED, ticket.packed()

    def _is_proper(self, request: Request) -> bool:
        box = self._boxes.get(request.mailbox)
        if box is None or len(request.message) != box.size:
            return False
        message = Message(
            message_dtype(box.fields, box.size), memoryview(bytearray(request.message))
        )
        return ProperContent(box.fields)(message)

    def _withdraw(self, asked: Asked) -> tuple[Code, bytes]:
        ticket = Ticket.unpacked(asked.question.payload)
        session = asked.asker, asked.head.launch
        for waiting in self._waiting:
            if (
                ticket is not None
                and waiting.session == session
                and waiting.claim.ticket == ticket.number
            ):
                waiting.until_ns = 0
        return Code.GRANTED, b""

    def _until_ns(self) -> int:
        return time.monotonic_ns() + round(CLIENT_S * 1e9)

    def _dismiss(self) -> None:
        """Let go of requests that have been issued and are not leased, and of those of clients that
        are gone."""
        now = time.monotonic_ns()
        kept = []
        for waiting in self._waiting:
            is_leased = self._table.hear(waiting.claim.entry, waiting.claim.ticket)
            if (waiting.waits or is_leased) and now < waiting.until_ns:
                kept.append(waiting)
                continue
            self._table.withdraw(waiting.claim.entry, waiting.claim.ticket)
            waiting.claim.leave()
        self._waiting = kept
