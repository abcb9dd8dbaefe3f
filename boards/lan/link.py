"""The link: a rack's session on the network, with everything that looks for others by itself
switched off.

What comes is kept in channels of fixed length, which overwrite the oldest; the adapter takes it in
its own cycles.

Strangers who fail their TLS handshake disturb nobody who is connected. But zenoh takes no new
connection for 0.1 s after each (its issue 2685), and over quic only one handshake at a time (2719).
A rack that also connects outwards is found all the same: where strangers may come, let each rack
list the others in `connect`, and let the firewall admit their addresses alone.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import zenoh

from rack.backplane.json_text import encode_json
from rack.boards.lan.access import access_control
from rack.boards.lan.config import Credential, LanTable
from rack.boards.lan.endpoint import Endpoint, endpoints_of, has_tls
from rack.boards.lan.envelope import MOST_ENVELOPE, Sealer
from rack.boards.lan.keys import ALL_ALIVE, alive_key, launch_and_cycle
from rack.levels.errors import LevelError

if TYPE_CHECKING:
    from rack.boards.lan.credentials import Credentials

UNREAD = 32
"""Messages of one import that wait for a cycle, at most; a newer one overwrites the oldest."""
TOKENS = 1024
"""Racks that may come or go between two cycles of an adapter."""
RETRY_MS = (50, 200)
"""Shortest and longest time between two attempts to connect."""
KEEP_ALIVES = 4
"""Signs of life within a lease."""
HANDSHAKE_MS = 3000
"""Longest time to open a connection."""
MOST_STEP = 65_536
"""Length of the longest step in lockstep, bytes."""
ZENOH_BYTES = 1024
"""What zenoh adds to the content of a message, at most: key expression, lengths, options."""
SOCKET = "unixsock-stream"
"""A Unix socket's protocol, as zenoh calls it."""
NO_WAIT = {"messages": ["query"], "flows": ["ingress"], "overwrite": {"congestion_control": "drop"}}


class Arrived(NamedTuple):
    """Something that has come: its key expression, its envelope if it has one, its content."""

    key: str
    envelope: bytes | None
    payload: bytes

    @classmethod
    def of(cls, sample: zenoh.Sample) -> Self:
        """Return what a sample of the network holds."""
        return cls(str(sample.key_expr), _bytes_of(sample.attachment), sample.payload.to_bytes())


class Question(NamedTuple):
    """A query that has come. `reply` sends an answer, a payload and its envelope.

    The asker is done when the next question is taken, or none is left.
    """

    asked: Arrived
    reply: Callable[[bytes, bytes], None]


class LanLink:
    """One open session of `rack`, or of an operator of that name.

    Raises `LevelError` if an endpoint cannot be opened, or the credentials cannot be used.
    """

    def __init__(self, rack: str, table: LanTable, is_operator: bool = False) -> None:
        self.rack = rack
        credentials = None
        if table.certificates is not None:
            # Only here: a rack without certificates does without the package for them.
            from rack.boards.lan.credentials import Credentials

            credentials = Credentials(Path(table.certificates), rack)
        try:
            self.sealer = Sealer(credentials, table.most_bytes)
            """Seals and opens what this rack sends and receives."""
            self.session = zenoh.open(_settings(rack, table, credentials, is_operator))
        except zenoh.ZError as error:
            why = " ".join(str(error).split())
            raise LevelError(
                f"adapter.lan: listen {', '.join(table.listen) or 'nowhere'}: {why}"
            ) from None
        except Credential as flaw:
            raise LevelError(f"adapter.lan: {flaw}") from None
        self._kept: list[Any] = []

    def publish(self, key: str, reliable: bool = False) -> Callable[[bytes, bytes], None]:
        """Return a function that sends payload and envelope under a key expression, and never
        waits.

        `reliable`: it waits for room instead; for lockstep only.
        """
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        publisher = self.session.declare_publisher(
            key, congestion_control=control, priority=zenoh.Priority.REAL_TIME, express=True
        )
        self._kept.append(publisher)
        put = publisher.put
        return lambda payload, envelope: put(payload, attachment=envelope)

    def _channel(
        self, declare: Callable[..., Any], key: str, unread: int, **options: bool
    ) -> Callable[[], Iterator[Any]]:
        """Declare something whose messages wait in a channel; return a function that yields those
        that have come since its last call, oldest first.
        """
        channel = declare(key, zenoh.handlers.RingChannel(unread), **options)
        self._kept.append(channel)

        def waiting() -> Iterator[Any]:
            # No more than may wait: a flood must not keep the cycle.
            for _ in range(unread):
                if (found := channel.try_recv()) is None:
                    return
                yield found

        return waiting

    def subscribe(self, key: str) -> Callable[[], Iterator[Arrived]]:
        """Return a function that yields what has come under a key expression since the last call,
        oldest first.
        """
        waiting = self._channel(self.session.declare_subscriber, key, UNREAD)
        return lambda: map(Arrived.of, waiting())

    def on(self, key: str, callback: Callable[[Arrived], None]) -> None:
        """Call a function in a thread of the network with everything that comes under a key
        expression, at once.
        """

        def take(sample: zenoh.Sample) -> None:
            callback(Arrived.of(sample))

        # Direct: a thread between would add its wake-up, and a queue without a bound.
        handler = zenoh.handlers.Callback(take, indirect=False)
        self._kept.append(self.session.declare_subscriber(key, handler))

    def answer(self, key: str, unread: int = UNREAD) -> Callable[[], Iterator[Question]]:
        """Return a function that yields the questions asked under a key expression since the last
        call, oldest first.

        A question under several keys at once is dropped unanswered.
        """
        waiting = self._channel(self.session.declare_queryable, key, unread)

        def questions() -> Iterator[Question]:
            for query in waiting():
                with query:
                    content = _bytes_of(query.payload) or b""
                    asked = Arrived(str(query.key_expr), _bytes_of(query.attachment), content)
                    if "*" not in asked.key:
                        yield Question(asked, _reply(query))

        return questions

    def declare_alive(self, launch: int, cycle_ns: int = 0) -> None:
        """Show others that this launch is there; after everything that they may send it. See
        `alive_key`.
        """
        self._kept.append(
            self.session.liveliness().declare_token(alive_key(self.rack, launch, cycle_ns))
        )

    def watch_alive(self) -> Callable[[], Iterator[tuple[str, int, bool]]]:
        """Return a function that yields rack, launch, and whether it has come or gone, of others,
        oldest first.
        """
        declare = self.session.liveliness().declare_subscriber
        waiting = self._channel(declare, ALL_ALIVE, TOKENS, history=True)

        def changes() -> Iterator[tuple[str, int, bool]]:
            for sample in waiting():
                key = str(sample.key_expr)
                if (found := launch_and_cycle(key)) is not None:
                    yield key.split("/")[1], found[0], sample.kind == zenoh.SampleKind.PUT

        return changes

    def close(self) -> None:
        """Leave the network: others see it at once."""
        self.session.close()  # type: ignore[no-untyped-call]


def _bytes_of(content: zenoh.ZBytes | None) -> bytes | None:
    return None if content is None else content.to_bytes()


def _reply(query: zenoh.Query) -> Callable[[bytes, bytes], None]:
    return lambda payload, envelope: query.reply(query.key_expr, payload, attachment=envelope)


def _settings(
    rack: str, table: LanTable, credentials: Credentials | None, is_operator: bool
) -> zenoh.Config:
    timed = f"#tls_handshake_timeout_ms={HANDSHAKE_MS}" if has_tls(table) else ""
    shortest, longest = RETRY_MS
    protocols = {
        SOCKET if endpoint.is_private else endpoint.protocol for endpoint in endpoints_of(table)
    }
    settings: dict[str, Any] = {
        "mode": "peer",
        # Nothing looks for others, or answers those who do. What zenoh keeps in shared memory it
        # leaves there.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "adminspace/enabled": False,
        "listen/endpoints": [f"{_locator(endpoint)}{timed}" for endpoint in table.listen],
        "connect/endpoints": list(map(_locator, table.connect)),
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        # A peer that is not there yet keeps nobody: opening would wait for it for half a second.
        "open/return_conditions/connect_scouted": False,
        "connect/retry": {
            "period_init_ms": shortest,
            "period_max_ms": longest,
            "period_increase_factor": 1,
        },
        "access_control": access_control(rack, table, is_operator),
        "transport/link/protocols": sorted(protocols) or ["tcp"],
        # Whoever opens a connection and says no more is forgotten; these many at once are borne.
        "transport/unicast/accept_timeout": HANDSHAKE_MS,
        "transport/unicast/open_timeout": HANDSHAKE_MS,
        "transport/link/rx/max_message_size": (
            max(table.most_bytes, MOST_STEP) + MOST_ENVELOPE + ZENOH_BYTES
        ),
        "transport/link/tx/lease": round(table.lease_ms),
        "transport/link/tx/keep_alive": KEEP_ALIVES,
        "transport/link/tx/queue/size/real_time": 16,
        # An answer takes over the congestion control of its question: whoever asks must not make
        # the adapter wait.
        "qos/network": [NO_WAIT],
        # What does wait for room, in lockstep, waits no longer than until the peer counts as lost.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(
            table.lease_ms * 1e3
        ),
    }
    if credentials is not None and has_tls(table):
        own = {"certificate": str(credentials.certificate), "private_key": str(credentials.key)}
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(credentials.authority),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            **{
                f"{side}_{key}": path for side in ("listen", "connect") for key, path in own.items()
            },
        }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, encode_json(value))
    return config


def _locator(text: str) -> str:
    """Return an endpoint as zenoh knows it. Raises `LevelError`: others may enter the folder of
    this user's sockets.
    """
    endpoint = Endpoint.of(text)
    if not endpoint.is_private:
        return text
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or "/tmp") / f"rack-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError as error:
        raise LevelError(f"adapter.lan: {folder}: {error.strerror}") from None
    if (
        not stat.S_ISDIR(about.st_mode)
        or about.st_uid != os.getuid()
        or about.st_mode & (stat.S_IRWXG | stat.S_IRWXO)
    ):
        raise LevelError(
            f"adapter.lan: {folder}: others may enter it; permitted: a folder of this user, mode"
            " 0700"
        )
    return f"{SOCKET}/{folder / endpoint.host}"
