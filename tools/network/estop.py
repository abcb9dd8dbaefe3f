"""The emergency stop of a rack on another machine.

A session with the racks at its host, which listens nowhere. A request is repeated until it is
answered or `PATIENCE_S` is over: a rack that gets many drops some.
"""

from __future__ import annotations

import ipaddress
import secrets
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

import zenoh

from rack.boards.lan.config import LanTable
from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.keys import estop_answer_key, estop_key
from rack.boards.lan.link import Arrived, LanLink
from rack.boards.lan.remote_estop import CHECK, ESTOP_KIND
from rack.levels.errors import LevelError
from rack.tools.console.address import Operator, RackAddress
from rack.tools.console.answer import Failure

CONNECT_S = 3.0
"""Longest wait for a connection, and for the racks at its other end to show themselves."""
OTHERS_S = 0.3
"""Longest wait for further racks at the other end of a connection, once one has shown itself."""
ANSWER_S = 1.0
"""Longest wait for one answer; after it the request is repeated."""
PATIENCE_S = 4.0
"""Time without an answer after which a rack counts as gone."""
PAUSE_S = 0.02
"""Time until a request is repeated that was dropped, and between two looks at who is there."""
DENIED_S = 1.0
"""Time for which all requests come back at once without an answer until that counts as not
permitted: the way to a rack that has just shown itself may not be there yet."""
LOOK_S = 0.2
"""Time between two looks at whether a rack is still there."""


class EstopSession:
    """A session at one host, in a context. Raises `Failure` when nobody is there, or it refuses
    this operator.
    """

    def __init__(self, address: RackAddress, operator: Operator) -> None:
        self._address = address
        self._operator = operator
        check_reach(address, operator)
        protocol = "tls" if operator.certificates else "tcp"
        endpoint = f"{protocol}/{address.host}:{address.port}"
        table = LanTable(connect=(endpoint,), certificates=operator.certificates or None)
        try:
            self._link = LanLink(operator.name, table, is_operator=True)
        except LevelError as error:
            raise Failure(str(error).replace("adapter.lan: ", "")) from None
        self._session = secrets.randbits(63)
        self._number = 0
        self._launches: dict[str, int] = {}
        self._changes = self._link.watch_alive()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._link.close()

    def _await(self, condition: Callable[[], object], bound_s: float) -> None:
        """Note who comes and goes, until a condition holds or the time is over."""
        end_s = time.monotonic() + bound_s
        while True:
            for rack, launch, is_there in self._changes():
                if is_there:
                    self._launches[rack] = launch
                elif self._launches.get(rack) == launch:
                    del self._launches[rack]
            if condition() or time.monotonic() > end_s:
                return
            time.sleep(PAUSE_S)

    def launch(self) -> int:
        """Return the number of the rack's launch. Raises `Failure` when it is not there: it names
        those that are.
        """
        rack = self._address.rack
        self._await(lambda: self._launches, CONNECT_S)
        self._await(lambda: rack in self._launches, OTHERS_S)
        if rack in self._launches:
            return self._launches[rack]
        there = ", ".join(sorted(self._launches))
        with_tls = "one with TLS needs --certificates"
        if self._operator.certificates:
            with_tls = "its certificate and yours must be of one authority"
        nobody = f"none that knows '{self._operator.name}'; {with_tls}"
        raise Failure(f"no rack '{rack}' at {self._address.at}; racks there: {there or nobody}")

    def set_stop(self, launch: int, flags: int = 0) -> int:
        """Set the emergency stop of the rack, or with `CHECK` find out whether it would be set.

        Args:
            launch: Number of the rack's launch: a restarted rack is another one.
            flags: 0, or `CHECK`.

        Returns:
            The tick at which the rack answered.

        Raises:
            Failure: It has ended, does not permit it, or does not answer.
        """
        rack = self._address.rack
        at = f"rack '{rack}' at {self._address.at}"
        first_s = time.monotonic()
        was_taken = False  # by the rack, at least once: its adapter answers in its next cycle
        while True:
            began_s = time.monotonic()
            if (tick := self._request(launch, flags)) is not None:
                return tick
            now_s = time.monotonic()
            was_taken |= now_s - began_s > ANSWER_S / 2
            self._await(lambda: True, 0.0)
            if self._launches.get(rack) != launch:
                raise Failure(f"{at} has ended, or is out of reach")
            if not was_taken and now_s - first_s > DENIED_S:
                raise Failure(
                    f"rack '{rack}' does not permit '{self._operator.name}' to stop it; its"
                    " config: adapter.lan.estop_from"
                )
            if now_s - first_s > PATIENCE_S:
                why = "its adapter does not cycle; does `rack step` hold it?"
                raise Failure(f"{at} has not answered for {PATIENCE_S:g} s: {why}")
            time.sleep(PAUSE_S)

    def _request(self, launch: int, flags: int) -> int | None:
        """Send a request once; return the tick of its answer, or None if there is none."""
        rack, name, sealer = self._address.rack, self._operator.name, self._link.sealer
        self._number += 1
        key = estop_key(name, rack)
        head = Envelope(ESTOP_KIND, self._session, self._number, 0, 0, 0, 0, flags)
        replies = self._link.session.get(
            key,
            zenoh.handlers.FifoChannel(2),
            timeout=ANSWER_S,
            congestion_control=zenoh.CongestionControl.DROP,
            attachment=sealer.seal(key, head, b""),
        )
        for reply in replies:
            if reply.ok is None:
                continue
            _, envelope, payload = Arrived.of(reply.ok)
            answer = sealer.opened(estop_answer_key(rack, name), envelope, payload)
            expected = launch, self._number, self._session
            # Launch, serial and number: it cannot be the answer to another request.
            if not isinstance(answer, Flaw) and answer[1:4] == expected:
                return answer.tick
        return None


def stop(address: RackAddress, operator: Operator) -> int:
    """Set the emergency stop of a rack; return the tick at which that was done. Raises
    `Failure`.
    """
    with EstopSession(address, operator) as session:
        return session.set_stop(session.launch())


def stop_when(
    pressed: Callable[[float], bool],
    address: RackAddress,
    operator: Operator,
    tell: Callable[[str], None],
) -> int:
    """Stay connected to a rack, and set its emergency stop when it is demanded.

    What is demanded while the rack is out of reach is tried until it is set.

    Args:
        pressed: Waits up to a time in s; returns True once the stop is demanded.
        address: The rack.
        operator: Who sets the stop.
        tell: Gets, again and again, whether the stop could be set.

    Returns:
        The tick at which it was set.

    Raises:
        Failure: It could not be set from the beginning.
    """
    with EstopSession(address, operator) as session:
        checked: int | None = None
        while checked is None or not pressed(LOOK_S):
            try:
                if (launch := session.launch()) != checked:
                    session.set_stop(launch, CHECK)
                    checked = launch
                tell(f"ready to stop rack '{address}'")
            except Failure as failure:
                if checked is None:
                    raise
                tell(f"not ready: {failure}")
        while True:
            try:
                return session.set_stop(session.launch())
            except Failure as failure:
                tell(f"not stopped yet: {failure}")


def check_reach(rack: RackAddress, operator: Operator) -> None:
    """Raise `Failure` when nobody listens there, or this operator has no certificate to show."""
    at = rack.at
    try:
        with socket.create_connection((rack.host.strip("[]"), rack.port), CONNECT_S) as connection:
            address = ipaddress.ip_address(connection.getpeername()[0].partition("%")[0])
    except TimeoutError:
        raise Failure(f"{at}: no answer at port {rack.port} within {CONNECT_S:g} s") from None
    except OSError as error:
        raise Failure(f"{at}: cannot connect to port {rack.port}: {error.strerror}") from None
    if operator.certificates:
        credentials = Credentials(Path(operator.certificates), operator.name)
        if (flaw := next(credentials.flaws(), None)) is not None:
            raise Failure(str(flaw))
    elif not address.is_loopback:
        raise Failure(f"{at}: not this machine, so it needs certificates; see --certificates", 2)
