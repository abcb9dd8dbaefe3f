"""A session with the racks at one host, and the questions that it asks them.

It listens nowhere and ends with its context. Everything is asked again until it is answered or `PATIENCE_S` is over: a
rack that many ask drops questions.
"""

from __future__ import annotations

import ipaddress
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

try:
    import zenoh
except ImportError:
    raise ImportError("HOST/RACK needs eclipse-zenoh; to install it: pip install nasrem-rack[lan]") from None

from rack.backplane.segment import VERSION
from rack.boards.lan.config import LanTable
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.keys import ALL_ALIVE
from rack.boards.lan.link import LanLink
from rack.boards.lan.questions import NEEDED, Code, DeskAnswer, What, answer_key, question_key
from rack.levels.errors import LevelError
from rack.tools.console.answer import Failure
from rack.tools.lan.address import Asker, HostAddress

CONNECT_S = 3.0
"""Longest wait for a connection, and for the racks at its other end to show themselves."""
ANSWER_S = 1.0
"""Longest wait for one answer; after it the question is asked again."""
PATIENCE_S = 4.0
"""Time without an answer after which a rack counts as gone."""
PAUSE_S = 0.02
"""Time until a question is asked again that was dropped."""
MOST_BYTES = 1 << 17


class Questioner:
    """A session at one host, in a context. Raises `Failure` when nobody is there, or it refuses this user."""

    def __init__(self, at: HostAddress, asker: Asker) -> None:
        self._at, self._asker = at, asker
        _check_reach(at, asker)
        protocol = "tls" if asker.certificates else "tcp"
        endpoint = f"{protocol}/{at.host}:{at.port}"
        table = LanTable(connect=(endpoint,), certificates=asker.certificates or None, most_bytes=MOST_BYTES)
        try:
            self._link = LanLink(asker.name, table, asks=True)
        except LevelError as error:
            raise Failure(str(error).replace("adapter.lan: ", "")) from None
        self._session, self._number = secrets.randbits(63), 0
        self._changed = threading.Condition()
        self._launches: dict[str, int] = {}
        self._token = self._link.session.liveliness().declare_subscriber(
            ALL_ALIVE, zenoh.handlers.Callback(self._note, indirect=False), history=True
        )
        self._until = threading.Event()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._link.close()

    def _note(self, sample: Any) -> None:
        _, rack, _, launch = str(sample.key_expr).split("/")
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._launches[rack] = int(launch, 16)
            elif self._launches.get(rack) == int(launch, 16):
                del self._launches[rack]
            self._changed.notify_all()

    def launch(self, rack: str) -> int:
        """Return the launch of a rack that is there. Raises `Failure` when it is not: it names those that are."""
        with self._changed:
            self._changed.wait_for(lambda: rack in self._launches, CONNECT_S)
            if rack in self._launches:
                return self._launches[rack]
            there = ", ".join(sorted(self._launches)) or "none that show themselves to "
            there += f"'{self._asker.name}'" if not self._launches else ""
        raise Failure(f"no rack '{rack}' at {self._at}; racks there: {there}")

    def racks(self) -> list[str]:
        """Return the racks there, once one has shown itself."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._launches), CONNECT_S)
            return sorted(self._launches)

    def is_there(self, rack: str, launch: int) -> bool:
        """Say whether a launch has not ended yet, as far as is known."""
        return self._launches.get(rack) == launch

    def ask(self, rack: str, launch: int, what: What, payloads: list[bytes]) -> Iterator[DeskAnswer]:
        """Yield the answers to questions of one kind, in their order. Raises `Failure` when there is none.

        All are on their way at once; one that gets no answer is asked again.
        """
        pending = [self._question(rack, what, payload) for payload in payloads]
        for payload, question in zip(payloads, pending, strict=True):
            yield self._granted(rack, what, self._answer(rack, launch, what, payload, question))

    def _question(self, rack: str, what: What, payload: bytes) -> tuple[int, str, Any]:
        self._number += 1
        key = question_key(rack, what, self._asker.name)
        head = Envelope(VERSION, self._session, self._number, 0, 0, 0, 0)
        replies = self._link.session.get(
            key,
            zenoh.handlers.FifoChannel(2),
            timeout=ANSWER_S,
            congestion_control=zenoh.CongestionControl.DROP,
            payload=payload,
            attachment=self._link.sealer.seal(key, head, payload),
        )
        return self._number, key, replies

    def _answer(
        self, rack: str, launch: int, what: What, payload: bytes, question: tuple[int, str, Any]
    ) -> DeskAnswer | None:
        """Return the answer to a question; None if there is none within the patience."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            number, key, replies = question
            for reply in replies:
                if (answer := self._opened(number, key, launch, reply)) is not None and answer.code is not Code.BUSY:
                    return answer
            if time.monotonic() > deadline or not self.is_there(rack, launch):
                return None
            self._until.wait(PAUSE_S)
            question = self._question(rack, what, payload)

    def _opened(self, number: int, key: str, launch: int, reply: Any) -> DeskAnswer | None:
        if (sample := reply.ok) is None:
            return None
        payload = sample.payload.to_bytes()
        envelope = None if sample.attachment is None else sample.attachment.to_bytes()
        head = self._link.sealer.opened(answer_key(key), envelope, payload)
        if isinstance(head, Flaw) or (head.number, head.serial, head.launch) != (self._session, number, launch):
            return None
        return DeskAnswer.unpacked(payload)

    def _granted(self, rack: str, what: What, answer: DeskAnswer | None) -> DeskAnswer:
        right, name = NEEDED[what], self._asker.name
        if answer is None:
            why = f"it does not permit '{name}' to {right} (its config: adapter.lan.permit), or its clock stands still"
            raise Failure(f"rack '{rack}' at {self._at} does not answer: {why}")
        if answer.code is Code.GRANTED:
            return answer
        reasons = {
            Code.NOT_PERMITTED: f"does not permit '{name}' to {right}; its config: adapter.lan.permit",
            Code.OTHER_VERSION: f"is of another version; this program asks racks of version {VERSION}",
            Code.OUTSIDE: "has no such memory",
            Code.NOT_VALID: "knows no such command",
            Code.PAST: "has passed that tick",
            Code.FULL: "has too many commands waiting; permitted: once one of them is given",
        }
        raise Failure(f"rack '{rack}' {reasons[answer.code]}")


def _check_reach(at: HostAddress, asker: Asker) -> None:
    """Raise `Failure` when nobody listens there, or it is too far to go without certificates."""
    host = at.host.strip("[]")
    try:
        with socket.create_connection((host, at.port), CONNECT_S) as found:
            address = ipaddress.ip_address(found.getpeername()[0].partition("%")[0])
    except TimeoutError:
        raise Failure(f"{at}: no answer at port {at.port} within {CONNECT_S:g} s") from None
    except OSError as error:
        why = os.strerror(error.errno) if isinstance(error.errno, int) and error.errno > 0 else error.strerror
        raise Failure(f"{at}: cannot connect to port {at.port}: {why or error}") from None
    if not asker.certificates and not address.is_loopback:
        raise Failure(f"{at}: not this machine, so it needs certificates; see --certificates", 2)
