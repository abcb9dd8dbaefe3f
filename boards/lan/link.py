"""Session of a rack on the network. Automatic discovery of other sessions is switched off.

Received messages wait in channels of fixed length, whose oldest entry is overwritten when they are
full. The adapter empties them in its cycles.

Failed TLS handshakes of strangers do not disturb existing connections. After each failure, however,
zenoh accepts no new connection for 0.1 s (its issue 2685), and over quic it handles only one
handshake at a time (2719). A rack that also connects outwards is found nevertheless. In a network
with strangers, let each rack list the others in `connect`, and let the firewall admit only their
addresses.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import zenoh

from rack.backplane.json_text import encode_json
from rack.boards.lan.access import build_access_control
from rack.boards.lan.config import CredentialError, LanTable
from rack.boards.lan.endpoint import Endpoint, has_tls, list_endpoints
from rack.boards.lan.envelope import MAX_ENVELOPE_BYTES, MAX_MESSAGE_BYTES, Sealer
from rack.boards.lan.keys import ALL_ALIVE, alive_key, parse_alive_key
from rack.levels.errors import LevelError

if TYPE_CHECKING:
    from rack.boards.lan.credentials import Credentials

MAX_UNREAD = 32
"""Maximum number of messages of one import that wait for the adapter's next cycle."""
MAX_TOKENS = 1024
"""Maximum number of liveliness changes that wait for the adapter's next cycle."""
RETRY_MS = (50, 200)
"""Shortest and longest interval between two attempts to connect."""
KEEP_ALIVES = 4
"""Number of keep-alive messages within a lease."""
HANDSHAKE_MS = 3000
"""Maximum time to open a connection."""
ZENOH_BYTES = 1024
"""Maximum overhead that zenoh adds to a message: key expression, lengths and options."""
SOCKET = "unixsock-stream"
"""Zenoh's name for the protocol of a Unix socket."""
NO_WAIT = {"messages": ["query"], "flows": ["ingress"], "overwrite": {"congestion_control": "drop"}}


class ReceivedMessage(NamedTuple):
    """A received message: its key expression, its envelope if it has one, and its content."""

    key: str
    envelope: bytes | None
    payload: bytes

    @classmethod
    def from_sample(cls, sample: zenoh.Sample) -> Self:
        """Copy key expression, envelope and payload from a zenoh sample."""
        return cls(str(sample.key_expr), _to_bytes(sample.attachment), sample.payload.to_bytes())


class Question(NamedTuple):
    """A received query. `reply` sends a payload, with its envelope as `attachment`, as an answer.

    The query stays open until the next question is taken or the channel is found empty.
    """

    asked: ReceivedMessage
    reply: Callable[..., None]


class LanLink:
    """Open zenoh session of a rack or an operator.

    Args:
        rack: Name of the rack or the operator.
        table: The `[adapter.lan]` table.
        is_operator: Whether the session belongs to an operator.

    Raises:
        LevelError: An endpoint cannot be opened, or the credentials cannot be used.

    Attributes:
        sealer: Seals and opens the messages of this session.
        session: The session of zenoh.
    """

    def __init__(self, rack: str, table: LanTable, is_operator: bool = False) -> None:
        self.rack = rack
        credentials = None
        if table.certificates is not None:
            # Imported late: racks without certificates do not need the cryptography package.
            from rack.boards.lan.credentials import Credentials

            credentials = Credentials(Path(table.certificates), rack)
        try:
            self.sealer = Sealer(credentials)
            self.session = zenoh.open(_build_settings(rack, table, credentials, is_operator))
        except zenoh.ZError as error:
            why = " ".join(str(error).split())
            raise LevelError(
                f"adapter.lan: cannot listen on {', '.join(table.listen) or 'no endpoint'}: {why}"
            ) from None
        except CredentialError as flaw:
            raise LevelError(f"adapter.lan: {flaw}") from None
        self._declared: list[Any] = []

    def publish(self, key: str, reliable: bool = False) -> Callable[[bytes, bytes], None]:
        """Return a function that sends a payload and its envelope under a key expression.

        If the send queue is full, the returned function drops the message. With `reliable`, which
        only lockstep uses, it waits for room in the queue.
        """
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        publisher = self.session.declare_publisher(
            key, congestion_control=control, priority=zenoh.Priority.REAL_TIME, express=True
        )
        self._declared.append(publisher)
        put = publisher.put
        return lambda payload, envelope: put(payload, attachment=envelope)

    def _open_channel(
        self, declare: Callable[..., Any], key: str, unread: int, **options: bool
    ) -> Callable[[], Iterator[Any]]:
        """Open a subscription or a query channel with a bounded buffer.

        Args:
            declare: Session method that declares the channel.
            key: Key expression.
            unread: Length of the buffer. If it is full, the oldest sample is overwritten.
            options: Further arguments of `declare`.

        Returns:
            A function that yields the samples since its last call, oldest first.
        """
        channel = declare(key, zenoh.handlers.RingChannel(unread), **options)
        self._declared.append(channel)

        def take_samples() -> Iterator[Any]:
            """Remove and yield the samples in the buffer, oldest first."""
            # Take at most one buffer's worth, so that a flood cannot prolong the cycle.
            for _ in range(unread):
                if (sample := channel.try_recv()) is None:
                    return
                yield sample

        return take_samples

    def subscribe(self, key: str) -> Callable[[], Iterator[ReceivedMessage]]:
        """Return a function that yields the new messages under a key expression, oldest first."""
        waiting = self._open_channel(self.session.declare_subscriber, key, MAX_UNREAD)
        return lambda: map(ReceivedMessage.from_sample, waiting())

    def call_on_arrival(self, key: str, callback: Callable[[ReceivedMessage], None]) -> None:
        """Call a function for each message under a key expression, in a thread of zenoh."""
        # Indirect callbacks would add the wake-up of another thread and an unbounded queue.
        handler: Any = zenoh.handlers.Callback(
            lambda sample: callback(ReceivedMessage.from_sample(sample)), indirect=False
        )
        self._declared.append(self.session.declare_subscriber(key, handler))

    def open_questions(self, key: str, unread: int) -> Callable[[], Iterator[Question]]:
        """Return a function that yields the new questions under a key expression, oldest first.

        A query with a wildcard in its key is dropped unanswered.
        """
        waiting = self._open_channel(self.session.declare_queryable, key, unread)

        def take_questions() -> Iterator[Question]:
            """Remove and yield the questions in the buffer that have no wildcard, oldest first."""
            for query in waiting():
                with query:
                    content = _to_bytes(query.payload) or b""
                    question = ReceivedMessage(
                        str(query.key_expr), _to_bytes(query.attachment), content
                    )
                    if "*" not in question.key:
                        yield Question(question, partial(query.reply, query.key_expr))

        return take_questions

    def declare_token(self, launch: int, cycle_ns: int = 0) -> None:
        """Declare the liveliness token of this launch.

        Call this after all subscriptions, because a rack that sees the token may send at once. In
        lockstep, `cycle_ns` is the length of the adapter's cycle: see `alive_key`.
        """
        self._declared.append(
            self.session.liveliness().declare_token(alive_key(self.rack, launch, cycle_ns))
        )

    def watch_tokens(self) -> Callable[[], Iterator[tuple[str, int, bool]]]:
        """Return a function that yields the changes of other racks' tokens since its last call.

        Each change has the rack, its launch, and True if the token has appeared or False if it has
        expired.
        """
        declare = self.session.liveliness().declare_subscriber
        waiting = self._open_channel(declare, ALL_ALIVE, MAX_TOKENS, history=True)

        def take_changes() -> Iterator[tuple[str, int, bool]]:
            """Remove and yield the changes in the buffer, oldest first."""
            for sample in waiting():
                key = str(sample.key_expr)
                if (parsed := parse_alive_key(key)) is not None:
                    yield key.split("/")[1], parsed[0], sample.kind == zenoh.SampleKind.PUT

        return take_changes

    def close(self) -> None:
        """Close the session. Other racks notice it at once."""
        self.session.close()  # type: ignore[no-untyped-call]


def _to_bytes(content: zenoh.ZBytes | None) -> bytes | None:
    """Convert a payload or an attachment to bytes. Return None if there is no content."""
    return None if content is None else content.to_bytes()


def _build_settings(
    rack: str, table: LanTable, credentials: Credentials | None, is_operator: bool
) -> zenoh.Config:
    """Return zenoh's configuration for the session of a rack or operator."""
    timed = f"#tls_handshake_timeout_ms={HANDSHAKE_MS}" if has_tls(table) else ""
    shortest, longest = RETRY_MS
    protocols = {
        SOCKET if endpoint.is_private else endpoint.protocol for endpoint in list_endpoints(table)
    }
    settings: dict[str, Any] = {
        "mode": "peer",
        # Disable discovery. Disable shared memory, because zenoh leaves its segments behind.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": False,
        "listen/endpoints": [f"{_to_locator(endpoint)}{timed}" for endpoint in table.listen],
        "connect/endpoints": list(map(_to_locator, table.connect)),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        # Do not wait for peers: opening would otherwise block for half a second for each.
        "open/return_conditions/connect_scouted": False,
        "connect/retry": {
            "period_init_ms": shortest,
            "period_max_ms": longest,
            "period_increase_factor": 1,
        },
        "access_control": build_access_control(rack, table, is_operator),
        "transport/link/protocols": sorted(protocols) or ["tcp"],
        # Drop connections that are opened but never used.
        "transport/unicast/accept_timeout": HANDSHAKE_MS,
        "transport/unicast/open_timeout": HANDSHAKE_MS,
        "transport/link/rx/max_message_size": (
            MAX_MESSAGE_BYTES + MAX_ENVELOPE_BYTES + ZENOH_BYTES
        ),
        "transport/link/tx/lease": round(table.lease_ms),
        "transport/link/tx/keep_alive": KEEP_ALIVES,
        "transport/link/tx/queue/size/real_time": 16,
        # An answer inherits the congestion control of its question. Sending it must not make the
        # adapter wait.
        "qos/network": [NO_WAIT],
        # In lockstep, sending waits for room in the queue, but at most for the lease time.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(
            table.lease_ms * 1e3
        ),
    }
    if credentials is not None and has_tls(table):
        paths = {"certificate": str(credentials.certificate), "private_key": str(credentials.key)}
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(credentials.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            **{
                f"{side}_{key}": path
                for side in ("listen", "connect")
                for key, path in paths.items()
            },
        }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, encode_json(value))
    return config


def _to_locator(text: str) -> str:
    """Convert an endpoint to zenoh's notation. For a Unix socket, create its folder.

    Raises:
        LevelError: The folder cannot be made, or users other than this one can access it.
    """
    endpoint = Endpoint.from_text(text)
    if not endpoint.is_private:
        return text
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or "/tmp") / f"rack-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise LevelError(f"adapter.lan: {folder}: {error.strerror}") from None
    if (
        not stat.S_ISDIR(status.st_mode)
        or status.st_uid != os.getuid()
        or status.st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    ):
        raise LevelError(
            f"adapter.lan: {folder}: others can access it; it must be a folder of this user with"
            " mode 0700"
        )
    return f"{SOCKET}/{folder / endpoint.host}"
