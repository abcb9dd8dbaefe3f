"""Emergency stop of a rack on another machine.

The operator's session connects to the racks at one host and does not listen. A rack that receives
many requests drops some, so a request is repeated until it is answered or `PATIENCE_S` is over.
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
from rack.boards.lan.link import LanLink, ReceivedMessage
from rack.boards.lan.remote_estop import CHECK_FLAG, ESTOP_KIND
from rack.levels.errors import LevelError
from rack.tools.console.address import Operator, RackAddress
from rack.tools.console.answer import Failure

CONNECT_S = 3.0
"""Maximum wait in s for a connection and for the rack at its other end."""
ANSWER_S = 1.0
"""Maximum wait for an answer. After that the request is repeated."""
PATIENCE_S = 4.0
"""Time without an answer after which a rack counts as gone."""
PAUSE_S = 0.02
"""Interval between two requests, and between two checks for racks."""
DENIED_S = 1.0
"""Time after which requests that return at once without an answer count as not permitted.

The path to a rack that has just appeared may not exist yet, so the first such return proves
nothing.
"""
PRESENCE_CHECK_S = 0.2
"""Interval at which the presence of a rack is checked."""


class EstopSession:
    """Context manager for an operator's session with the racks at one host.

    Raises:
        Failure: Nothing listens at the host, or it refuses this operator.
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
        self._changes = self._link.watch_tokens()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._link.close()

    def _wait_until(self, condition: Callable[[], object], bound_s: float) -> None:
        """Track which racks are present until a condition holds or `bound_s` s have passed."""
        end_s = time.monotonic() + bound_s
        while True:
            for rack, launch, has_appeared in self._changes():
                if has_appeared:
                    self._launches[rack] = launch
                elif self._launches.get(rack) == launch:
                    del self._launches[rack]
            if condition() or time.monotonic() > end_s:
                return
            time.sleep(PAUSE_S)

    def find_launch(self) -> int:
        """Wait until the rack is present and return the number of its launch.

        Raises:
            Failure: The rack does not appear in time. The message names the racks that are present.
        """
        rack = self._address.rack
        self._wait_until(lambda: rack in self._launches, CONNECT_S)
        if rack in self._launches:
            return self._launches[rack]
        present = ", ".join(sorted(self._launches))
        with_tls = "one with TLS needs --certificates"
        if self._operator.certificates:
            with_tls = "its certificate and yours must be of one authority"
        nobody = f"none that knows '{self._operator.name}'; {with_tls}"
        raise Failure(
            f"no rack '{rack}' at {self._address.endpoint}; racks there: {present or nobody}"
        )

    def set_stop(self, launch: int, flags: int = 0) -> int:
        """Set the emergency stop of the rack, or only check that this is permitted.

        Args:
            launch: Number of the rack's launch. A restarted rack has another number.
            flags: 0 to set the stop, or `CHECK_FLAG` to check only.

        Returns:
            The tick at which the rack answered.

        Raises:
            Failure: The rack has ended, does not permit the stop, or does not answer.
        """
        rack = self._address.rack
        rack_text = f"rack '{rack}' at {self._address.endpoint}"
        first_s = time.monotonic()
        # True once the rack has accepted a request, which its adapter answers in its next cycle.
        was_taken = False
        while True:
            began_s = time.monotonic()
            if (tick := self._send_request(launch, flags)) is not None:
                return tick
            now_s = time.monotonic()
            was_taken |= now_s - began_s > ANSWER_S / 2
            self._wait_until(lambda: True, 0.0)
            if self._launches.get(rack) != launch:
                raise Failure(f"{rack_text} has ended, or is out of reach")
            if not was_taken and now_s - first_s > DENIED_S:
                raise Failure(
                    f"rack '{rack}' does not permit '{self._operator.name}' to stop it;"
                    " name it in adapter.lan.estop_from of the rack's config"
                )
            if now_s - first_s > PATIENCE_S:
                why = "its adapter does not cycle; does `rack step` hold it?"
                raise Failure(f"{rack_text} has not answered for {PATIENCE_S:g} s: {why}")
            time.sleep(PAUSE_S)

    def _send_request(self, launch: int, flags: int) -> int | None:
        """Send a request once. Return the tick of its answer, or None if there is none."""
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
            _, envelope, payload = ReceivedMessage.from_sample(reply.ok)
            answer = sealer.open_message(estop_answer_key(rack, name), envelope, payload)
            expected = launch, self._number, self._session
            # Compare launch, serial and number, so that an answer to another request is ignored.
            if not isinstance(answer, Flaw) and answer[1:4] == expected:
                return answer.tick
        return None


def stop_rack(address: RackAddress, operator: Operator) -> int:
    """Set the emergency stop of a rack and return the tick at which it was set.

    Raises:
        Failure: The stop could not be set.
    """
    with EstopSession(address, operator) as session:
        return session.set_stop(session.find_launch())


def stop_when(
    pressed: Callable[[float], bool],
    address: RackAddress,
    operator: Operator,
    tell: Callable[[str], None],
) -> int:
    """Stay connected to a rack and set its emergency stop when the operator asks for it.

    If the rack is out of reach at that time, the request is repeated until the stop is set.

    Args:
        pressed: Waits for at most the given time in s. Returns True if the operator asks for the
            stop.
        address: Address of the rack.
        operator: Name and certificates of whoever sets the stop.
        tell: Called repeatedly with a text that says whether the stop can be set.

    Returns:
        The tick at which the stop was set.

    Raises:
        Failure: The first check finds that the stop cannot be set.
    """
    with EstopSession(address, operator) as session:
        checked_launch: int | None = None
        while checked_launch is None or not pressed(PRESENCE_CHECK_S):
            try:
                if (launch := session.find_launch()) != checked_launch:
                    session.set_stop(launch, CHECK_FLAG)
                    checked_launch = launch
                tell(f"ready to stop rack '{address}'")
            except Failure as failure:
                if checked_launch is None:
                    raise
                tell(f"not ready: {failure}")
        while True:
            try:
                return session.set_stop(session.find_launch())
            except Failure as failure:
                tell(f"not stopped yet: {failure}")


def check_reach(rack: RackAddress, operator: Operator) -> None:
    """Check that a rack can be reached.

    Raises:
        Failure: Nothing listens there, or the operator has no usable certificate but needs one.
    """
    host_text = rack.endpoint
    try:
        with socket.create_connection((rack.host.strip("[]"), rack.port), CONNECT_S) as connection:
            address = ipaddress.ip_address(connection.getpeername()[0].partition("%")[0])
    except TimeoutError:
        raise Failure(
            f"{host_text}: no answer at port {rack.port} within {CONNECT_S:g} s"
        ) from None
    except OSError as error:
        raise Failure(
            f"{host_text}: cannot connect to port {rack.port}: {error.strerror}"
        ) from None
    if operator.certificates:
        credentials = Credentials(Path(operator.certificates), operator.name)
        if (flaw := next(credentials.find_flaws(), None)) is not None:
            raise Failure(str(flaw))
    elif not address.is_loopback:
        raise Failure(
            f"{host_text} is another machine, so a stop needs certificates; see --certificates", 2
        )
