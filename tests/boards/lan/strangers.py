"""Sessions of others on the network, for tests: `python -m tests.boards.lan.strangers SESSIONS`,
SESSIONS being JSON.

They are plain sessions of zenoh with no rules of their own: each sends, asks and listens as its
table says. To each line on stdin it answers with one of JSON: what each has got so far. It ends
with its stdin.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import Sealer
from rack.boards.lan.keys import ALL_ALIVE
from tests.boards.lan.home import HEAD, open_session, serve

PERIOD_S = 0.02
ASKED_EVERY = 5


class Stranger:
    """One session. `table`: settings, the folder and name of its seals, puts (key, bytes, key
    sealed for), asks, keys to listen to, token."""

    def __init__(self, table: dict[str, Any]) -> None:
        # Zenoh takes no connection for 0.1 s after each that fails: strangers that try often would
        # keep the others out.
        again = 1000 if table.get("fails") else 50
        retry = {"period_init_ms": again, "period_max_ms": again, "period_increase_factor": 1}
        own = {"transport/shared_memory/enabled": False, "connect/retry": retry}
        own["open/return_conditions/connect_scouted"] = False
        self._session = session = open_session({**own, **table["settings"]})
        folder, name = table.get("seals", ("", ""))
        sealer = Sealer(Credentials(Path(folder), name)) if folder else Sealer()
        self._puts = []
        for key, size, sealed_for in table.get("puts", []):
            payload = bytes(size)
            attachment = None if sealed_for is None else sealer.seal(sealed_for, HEAD, payload)
            self._puts.append((key, payload, attachment))
        self._asks, self._cycles = table.get("asks", []), 0
        ring = zenoh.handlers.RingChannel(64)
        self._heard = [session.declare_subscriber(key, ring) for key in table.get("listens", [])]
        alive, keys = session.liveliness(), ("**", ALL_ALIVE)
        self._tokens = [
            alive.declare_subscriber(key, zenoh.handlers.RingChannel(64), history=True)
            for key in keys
        ]
        self._token = alive.declare_token(token) if (token := table.get("token")) else None
        self._got = {name: Counter[str]() for name in ("heard", "tokens", "answers")}

    def cycle(self) -> None:
        for key, payload, attachment in self._puts:
            self._session.put(
                key, payload, attachment=attachment, allowed_destination=zenoh.Locality.REMOTE
            )
        self._cycles += 1
        for key in self._asks if self._cycles % ASKED_EVERY == 0 else ():
            self._session.get(key, self._on_answer, payload=b"?", timeout=1.0)
        for name, subscribers in (("heard", self._heard), ("tokens", self._tokens)):
            self._got[name].update(
                str(sample.key_expr) for one in subscribers for sample in iter(one.try_recv, None)
            )

    def _on_answer(self, reply: zenoh.Reply) -> None:
        self._got["answers"][str(reply.ok.key_expr) if reply.ok else "error"] += 1

    def state(self) -> dict[str, Any]:
        """Return what it has got so far, and whether it is connected."""
        with suppress(zenoh.ZError):
            return {**self._got, "connected": bool(self._session.info.peers_zid())}
        return {**self._got, "connected": False}


def main(sessions: str) -> None:
    strangers = {name: Stranger(table) for name, table in json.loads(sessions).items()}

    def cycle() -> None:
        for stranger in strangers.values():
            stranger.cycle()

    serve(cycle, lambda: {name: stranger.state() for name, stranger in strangers.items()}, PERIOD_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
