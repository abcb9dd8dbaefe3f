"""The link: a rack's session on the network, with everything that looks for others by itself switched off.

Key expressions, R being the name of the rack that sends:

    rack/R/alive/<launch>       liveliness token: gone when the adapter's process ends or falls silent for the lease;
                                in lockstep its cycle follows, ns, after a hyphen
    rack/R/out/<board>/<port>   an exported mailbox
    rack/R/step                 lockstep: the cycles of R's adapter, each with all that it exports
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
ALIVE = "rack/*/alive/*"
"""Key expressions of all tokens."""


class Arrived(NamedTuple):
    """Something that has come: its key expression, its envelope if it has one, its content."""

    key: str
    envelope: bytes | None
    payload: bytes


def out_key(rack: str, mailbox: str) -> str:
    """Return the key expression of an exported mailbox."""
    return f"rack/{rack}/out/{mailbox.replace('.', '/')}"


def step_key(rack: str) -> str:
    """Return the key expression of a rack's steps."""
    return f"rack/{rack}/step"


def alive_key(rack: str, launch: int, cycle_ns: int = 0) -> str:
    """Return the key expression of a launch's token; in lockstep with the length of its adapter's cycle, ns."""
    return f"rack/{rack}/alive/{launch:016x}" + (f"-{cycle_ns}" if cycle_ns else "")


def launch_and_cycle(alive: str) -> tuple[int, int]:
    """Return the launch of a token, and the length of its adapter's cycle in ns; 0: it runs in real time."""
    launch, _, cycle_ns = alive.rpartition("/")[2].partition("-")
    return int(launch, 16), int(cycle_ns or 0)


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
                envelope = sample.attachment
                yield Arrived(
                    str(sample.key_expr), None if envelope is None else envelope.to_bytes(), sample.payload.to_bytes()
                )

        return arrived

    def declare_alive(self, launch: int, cycle_ns: int = 0) -> None:
        """Show others that this launch is there; after everything that they may send it. See `alive_key`."""
        self._kept.append(self.session.liveliness().declare_token(alive_key(self.rack, launch, cycle_ns)))

    def watch_alive(self, unread: int = UNREAD) -> Callable[[], Iterator[tuple[str, int, bool]]]:
        """Return a function that yields rack, launch, and whether it has come or gone, of others, oldest first."""
        subscriber = self.session.liveliness().declare_subscriber(
            ALIVE, zenoh.handlers.RingChannel(unread), history=True
        )
        self._kept.append(subscriber)

        def changes() -> Iterator[tuple[str, int, bool]]:
            for _ in range(unread):
                if (sample := subscriber.try_recv()) is None:
                    return
                key = str(sample.key_expr)
                yield key.split("/")[1], launch_and_cycle(key)[0], sample.kind == zenoh.SampleKind.PUT

        return changes

    def close(self) -> None:
        """Leave the network: others see it at once."""
        self.session.close()  # type: ignore[no-untyped-call]


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
