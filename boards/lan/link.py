"""The link: a rack's session on the network, with everything that looks for others by itself switched off.

Key expressions, R being the name of the rack that sends:

    rack/R/alive/<launch>       liveliness token: gone when the adapter's process ends or falls silent for the lease
    rack/R/out/<board>/<port>   an exported mailbox
    rack/R/step                 lockstep: the end of a cycle of R's adapter
    rack/R/ping/<to>, .../pong/<to>   round trips between clocks
    rack/R/ask/<what>           questions to R: answered in its adapter's cycles

What comes is kept in channels of fixed length, which overwrite the oldest; the adapter takes it in its own cycles.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import zenoh

from rack.boards.lan.config import LanTable
from rack.levels.errors import LevelError

UNREAD = 32
"""Messages of one import that wait for a cycle, at most; a newer one overwrites the oldest."""
RETRY_MS = (50, 200)
"""Shortest and longest time between two attempts to connect."""
KEEP_ALIVES = 4
"""Signs of life within a lease."""


class Arrived(NamedTuple):
    """Something that has come: its key expression, its envelope if it has one, its content."""

    key: str
    envelope: bytes | None
    payload: bytes


class Question(NamedTuple):
    """A question that has come. `reply` sends one answer, a payload and its envelope.

    Several answers reach only those who ask with `ConsolidationMode.NONE`. The asker is done when the next question is
    taken, or none is left.
    """

    key: str
    envelope: bytes | None
    payload: bytes
    reply: Callable[[bytes, bytes], None]


def out_key(rack: str, mailbox: str) -> str:
    """Return the key expression of an exported mailbox."""
    return f"rack/{rack}/out/{mailbox.replace('.', '/')}"


def alive_key(rack: str, launch: int) -> str:
    """Return the key expression of a launch's token."""
    return f"rack/{rack}/alive/{launch:016x}"


class LanLink:
    """One open session. Raises `LevelError` if an endpoint cannot be opened."""

    def __init__(self, rack: str, table: LanTable) -> None:
        self.rack = rack
        try:
            self.session = zenoh.open(_settings(table))
        except zenoh.ZError as error:
            why = " ".join(str(error).split())
            raise LevelError(f"adapter.lan: listen {', '.join(table.listen) or 'nowhere'}: {why}") from None
        self._kept: list[Any] = []

    def publish(self, key: str, reliable: bool = False) -> Callable[[bytes, bytes], None]:
        """Return a function that sends payload and envelope under a key expression, and never waits.

        `reliable`: it waits for room instead; for lockstep only.
        """
        control = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        publisher = self.session.declare_publisher(
            key, congestion_control=control, priority=zenoh.Priority.REAL_TIME, express=True
        )
        self._kept.append(publisher)
        put = publisher.put
        return lambda payload, envelope: put(payload, attachment=envelope)

    def subscribe(self, key: str, unread: int = UNREAD) -> Callable[[], Iterator[Arrived]]:
        """Return a function that yields what has come under a key expression since the last call, oldest first."""
        subscriber = self.session.declare_subscriber(key, zenoh.handlers.RingChannel(unread))
        self._kept.append(subscriber)
        take = subscriber.try_recv

        def arrived() -> Iterator[Arrived]:
            # No more than may wait: a flood must not keep the cycle.
            for _ in range(unread):
                if (sample := take()) is None:
                    return
                yield Arrived(str(sample.key_expr), _bytes_of(sample.attachment), sample.payload.to_bytes())

        return arrived

    def on(self, key: str, callback: Callable[[Arrived], None]) -> None:
        """Call a function in a thread of the network with everything that comes under a key expression, at once."""

        def take(sample: zenoh.Sample) -> None:
            callback(Arrived(str(sample.key_expr), _bytes_of(sample.attachment), sample.payload.to_bytes()))

        # Direct: a thread between would add its wake-up, and a queue without a bound.
        self._kept.append(self.session.declare_subscriber(key, zenoh.handlers.Callback(take, indirect=False)))

    def answer(self, key: str, unread: int = UNREAD) -> Callable[[], Iterator[Question]]:
        """Return a function that yields the questions asked under a key expression since the last call, oldest first.

        A question under several keys at once is dropped unanswered.
        """
        queryable = self.session.declare_queryable(key, zenoh.handlers.RingChannel(unread))
        self._kept.append(queryable)

        def questions() -> Iterator[Question]:
            for _ in range(unread):
                if (query := queryable.try_recv()) is None:
                    return
                with query:
                    asked, content = str(query.key_expr), _bytes_of(query.payload) or b""
                    if "*" not in asked:
                        yield Question(asked, _bytes_of(query.attachment), content, _reply(query))

        return questions

    def declare_alive(self, launch: int) -> None:
        """Show others that this launch is there; after everything that they may send it."""
        self._kept.append(self.session.liveliness().declare_token(alive_key(self.rack, launch)))

    def watch_alive(self, unread: int = UNREAD) -> Callable[[], Iterator[tuple[str, int, bool]]]:
        """Return a function that yields rack, launch, and whether it has come or gone, of others, oldest first."""
        subscriber = self.session.liveliness().declare_subscriber(
            "rack/*/alive/*", zenoh.handlers.RingChannel(unread), history=True
        )
        self._kept.append(subscriber)

        def changes() -> Iterator[tuple[str, int, bool]]:
            for _ in range(unread):
                if (sample := subscriber.try_recv()) is None:
                    return
                _, rack, _, launch = str(sample.key_expr).split("/")
                yield rack, int(launch, 16), sample.kind == zenoh.SampleKind.PUT

        return changes

    def close(self) -> None:
        """Leave the network: others see it at once."""
        self.session.close()  # type: ignore[no-untyped-call]


def _bytes_of(content: zenoh.ZBytes | None) -> bytes | None:
    return None if content is None else content.to_bytes()


def _reply(query: zenoh.Query) -> Callable[[bytes, bytes], None]:
    return lambda payload, envelope: query.reply(query.key_expr, payload, attachment=envelope)


def _settings(table: LanTable) -> zenoh.Config:
    config = zenoh.Config()

    def put(key: str, value: Any) -> None:
        config.insert_json5(key, json.dumps(value))

    put("mode", "peer")
    # Nothing looks for others, or answers those who do. What zenoh keeps in shared memory it leaves there.
    for key in ("scouting/multicast", "scouting/gossip", "transport/shared_memory", "adminspace"):
        put(f"{key}/enabled", False)
    put("listen/endpoints", list(table.listen))
    put("connect/endpoints", list(table.connect))
    put("connect/timeout_ms", -1)
    put("connect/exit_on_failure", False)
    shortest, longest = RETRY_MS
    put("connect/retry", {"period_init_ms": shortest, "period_max_ms": longest, "period_increase_factor": 1})
    put("transport/link/tx/lease", round(table.lease_ms))
    put("transport/link/tx/keep_alive", KEEP_ALIVES)
    put("transport/link/tx/queue/size/real_time", 16)
    return config
