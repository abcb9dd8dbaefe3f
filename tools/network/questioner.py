"""A session with the racks at one host, and the questions that it asks them.

It listens nowhere and ends with its context. Everything is asked again until it is answered or
`PATIENCE_S` is over: a rack that many ask drops questions.
"""

from __future__ import annotations

import ipaddress
import os
import secrets
import socket
import ssl
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, Self

import zenoh

from rack.backplane.segment import VERSION
from rack.boards.lan.config import LanTable, Right
from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.keys import ALL_ALIVE, launch_and_cycle
from rack.boards.lan.link import LanLink
from rack.boards.lan.questions import NEEDED, Code, DeskAnswer, What, answer_key, question_key
from rack.levels.errors import LevelError
from rack.tools.console.address import AT_THE_RACK, Asker, HostAddress
from rack.tools.console.answer import Failure

CONNECT_S = 3.0
"""Longest wait for a connection, and for the racks at its other end to show themselves."""
OTHERS_S = 0.3
"""Longest wait for further racks at the other end of a connection, once one has shown itself."""
ANSWER_S = 1.0
"""Longest wait for one answer; after it the question is asked again."""
PATIENCE_S = 4.0
"""Time without an answer after which a rack counts as gone."""
PAUSE_S = 0.02
"""Time until a question is asked again that was dropped."""
REFUSAL_S = 0.2
"""Longest wait for the refusal of a certificate."""
DENIED_S = 1.0
"""Time for which all questions come back at once without an answer until that counts as not
permitted: the way to a rack that has just shown itself may not be there yet."""
MOST_BYTES = 1 << 17


class FarLaunch(NamedTuple):
    """One launch of a rack: a restarted rack is another one."""

    rack: str
    launch: int


class _Question(NamedTuple):
    """A question on its way; `first` is the number under which it was asked for the first time:
    nothing is done twice."""

    asked: FarLaunch
    what: What
    payload: bytes
    number: int
    first: int
    key: str
    replies: Any


class Questioner:
    """A session at one host, in a context. Raises `Failure` when nobody is there, or it refuses
    this user."""

    def __init__(self, at: HostAddress, asker: Asker) -> None:
        self._at = at
        self._asker = asker
        check_reach(at, asker)
        protocol = "tls" if asker.certificates else "tcp"
        endpoint = f"{protocol}/{at.host}:{at.port}"
        table = LanTable(
            connect=(endpoint,), certificates=asker.certificates or None, most_bytes=MOST_BYTES
        )
        try:
            self._link = LanLink(asker.name, table, asks=True)
        except LevelError as error:
            raise Failure(str(error).replace("adapter.lan: ", "")) from None
        self._session = secrets.randbits(63)
        self._number = 0
        self._changed = threading.Condition()
        self._launches: dict[str, int] = {}
        self._token = self._link.session.liveliness().declare_subscriber(
            ALL_ALIVE, zenoh.handlers.Callback(self._note, indirect=False), history=True
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._link.close()

    def _note(self, sample: Any) -> None:
        """Note who comes and goes; a token that is not one of a rack's adapter is nobody's."""
        key = str(sample.key_expr)
        if (found := launch_and_cycle(key)) is None:
            return
        rack = key.split("/")[1]
        launch, _ = found
        with self._changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._launches[rack] = launch
            elif self._launches.get(rack) == launch:
                del self._launches[rack]
            self._changed.notify_all()

    def launch(self, rack: str) -> FarLaunch:
        """Return the launch of a rack that is there. Raises `Failure` when it is not: it names
        those that are."""
        with self._changed:
            self._changed.wait_for(lambda: self._launches, CONNECT_S)
            self._changed.wait_for(lambda: rack in self._launches, OTHERS_S)
            if rack in self._launches:
                return FarLaunch(rack, self._launches[rack])
            there = ", ".join(sorted(self._launches))
        raise Failure(f"no rack '{rack}' at {self._at}; racks there: {there or self._nobody()}")

    def racks(self) -> list[str]:
        """Return the racks there, once one has shown itself. Raises `Failure` when none does."""
        with self._changed:
            if not self._changed.wait_for(lambda: bool(self._launches), CONNECT_S):
                raise Failure(f"{self._at}: racks there: {self._nobody()}")
            return sorted(self._launches)

    def _nobody(self) -> str:
        hint = "" if self._asker.certificates else "; one with TLS needs --certificates"
        return f"none that knows '{self._asker.name}'{hint}"

    def ask(self, asked: FarLaunch, what: What, payloads: Sequence[bytes]) -> Iterator[DeskAnswer]:
        """Yield the answers to questions of one kind, in their order. Raises `Failure` when one has
        none, or a refusal.

        All are on their way at once; one that comes back without an answer is asked again.
        """
        pending = [self._question(asked, what, payload) for payload in payloads]
        for question in pending:
            yield self._granted(asked.rack, what, self._answer(question))

    def check_stop(self, asked: FarLaunch) -> None:
        """Raise `Failure` unless an emergency stop would be set: a reset goes the same way, with
        the same right, and is refused at its end."""
        answer = self._answer(self._question(asked, "reset", b""))
        if answer.code is not Code.AT_THE_RACK:
            self._granted(asked.rack, "reset", answer)

    def _question(
        self, asked: FarLaunch, what: What, payload: bytes, first: int | None = None
    ) -> _Question:
        """Ask, or, with `first`, ask again."""
        self._number += 1
        first = self._number if first is None else first
        key = question_key(asked.rack, what, self._asker.name)
        head = Envelope(VERSION, self._session, self._number, first, 0, 0, 0)
        replies = self._link.session.get(
            key,
            zenoh.handlers.FifoChannel(2),
            timeout=ANSWER_S,
            congestion_control=zenoh.CongestionControl.DROP,
            payload=payload,
            attachment=self._link.sealer.seal(key, head, payload),
        )
        return _Question(asked, what, payload, self._number, first, key, replies)

    def _answer(self, question: _Question) -> DeskAnswer:
        """Return the answer to a question. Raises `Failure` when there is none within the
        patience."""
        asked = question.asked
        began = first = time.monotonic()
        is_taken = False  # by the rack, at least once: it is busy, or dropped the question
        while True:
            for reply in question.replies:
                answer = self._opened(question, reply)
                if answer is not None and answer.code is not Code.BUSY:
                    return answer
                is_taken = is_taken or answer is not None
            now = time.monotonic()
            is_taken = is_taken or now - began > ANSWER_S / 2
            rack = f"rack '{asked.rack}' at {self._at}"
            if self._launches.get(asked.rack) != asked.launch:
                raise Failure(f"{rack} has ended, or is out of reach")
            if not is_taken and now - first > DENIED_S:
                why = not_permitted(self._asker, NEEDED[question.what])
                raise Failure(f"rack '{asked.rack}' {why}")
            if now - first > PATIENCE_S:
                why = "its adapter does not cycle; does `rack step` hold it?"
                raise Failure(f"{rack} has not answered for {PATIENCE_S:g} s: {why}")
            time.sleep(PAUSE_S)
            began = time.monotonic()
            question = self._question(asked, question.what, question.payload, question.first)

    def _opened(self, question: _Question, reply: Any) -> DeskAnswer | None:
        if (sample := reply.ok) is None:
            return None
        payload = sample.payload.to_bytes()
        envelope = None if sample.attachment is None else sample.attachment.to_bytes()
        head = self._link.sealer.opened(answer_key(question.key), envelope, payload)
        wanted = self._session, question.number, question.asked.launch
        if isinstance(head, Flaw) or (head.number, head.serial, head.launch) != wanted:
            return None
        return DeskAnswer.unpacked(payload)

    def _granted(self, rack: str, what: What, answer: DeskAnswer) -> DeskAnswer:
        if answer.code is Code.GRANTED:
            return answer
        reasons = {
            Code.NOT_PERMITTED: not_permitted(self._asker, NEEDED[what]),
            Code.OTHER_VERSION: (
                f"is of another version; this program asks racks of version {VERSION}"
            ),
            Code.OUTSIDE: "has no such memory",
            Code.NOT_VALID: "knows no such command",
            Code.PAST: "has passed that tick",
            Code.AT_THE_RACK: AT_THE_RACK.format(rack),
            Code.FULL: "has too many commands waiting; permitted: once one of them is given",
        }
        raise Failure(f"rack '{rack}' {reasons[answer.code]}")


def not_permitted(asker: Asker, right: Right) -> str:
    """Return why a rack refuses what its config does not permit."""
    return f"does not permit '{asker.name}' to {right}; its config: adapter.lan.permit"


def check_reach(at: HostAddress, asker: Asker) -> None:
    """Raise `Failure` when nobody listens there, it refuses this user's certificate, or there is
    none to show."""
    host = at.host.strip("[]")
    try:
        with socket.create_connection((host, at.port), CONNECT_S) as connection:
            address = ipaddress.ip_address(connection.getpeername()[0].partition("%")[0])
            if asker.certificates:
                _shake_hands(connection, host, asker)
    except ssl.SSLCertVerificationError as error:
        raise Failure(f"{at}: its certificate is refused here: {error.verify_message}") from None
    except (ssl.SSLError, ConnectionResetError) as error:
        why = (getattr(error, "reason", None) or "connection closed").replace("_", " ").lower()
        raise Failure(f"{at}: TLS refused: {why}") from None
    except TimeoutError:
        raise Failure(f"{at}: no answer at port {at.port} within {CONNECT_S:g} s") from None
    except OSError as error:
        why = error.strerror or str(error)
        # The resolver's errors have negative numbers, and a text of their own.
        if error.errno is not None and error.errno > 0:
            why = os.strerror(error.errno)
        raise Failure(f"{at}: cannot connect to port {at.port}: {why}") from None
    if not asker.certificates and not address.is_loopback:
        raise Failure(f"{at}: not this machine, so it needs certificates; see --certificates", 2)


def _shake_hands(connection: socket.socket, host: str, asker: Asker) -> None:
    """Show the certificate and look at the other one, as the session will: it would only try again
    and again."""
    credentials = Credentials(Path(asker.certificates), asker.name)
    if (flaw := next(credentials.flaws(), None)) is not None:
        raise Failure(str(flaw))
    context = ssl.create_default_context(cafile=credentials.authority)
    context.load_cert_chain(credentials.certificate, credentials.key)
    with context.wrap_socket(connection, server_hostname=host) as secure:
        # The other side judges our certificate after its own part is done: a refusal comes as the
        # first thing to read.
        secure.settimeout(REFUSAL_S)
        with suppress(TimeoutError):
            secure.recv(1)
