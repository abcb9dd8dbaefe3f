"""A rack's link at work, for tests: `python -m tests.boards.lan.home RACK TABLE`, TABLE being JSON.

It takes what comes every 5 ms, as an adapter does in its cycles, and sends a message for each
export. To each line on stdin it answers with one of JSON: what has come so far. It ends with its
stdin.
"""

from __future__ import annotations

import json
import select
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import zenoh

from rack.boards.lan.config import LanTable
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.keys import estop_key, out_key
from rack.boards.lan.link import MAX_UNREAD, LanLink

HEAD = Envelope(1, 2, 3, 4, 5, 6, 7)
PERIOD_S = 0.005
LAUNCH = 7


def open_session(settings: Mapping[str, Any]) -> zenoh.Session:
    """Open a plain session, with no rules of its own, that looks for nobody but its endpoints."""
    config, quiet = zenoh.Config(), {"mode": "peer", "connect/timeout_ms": -1}
    quiet |= {f"scouting/{way}/enabled": False for way in ("multicast", "gossip")}
    for key, value in {**quiet, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class Home:
    """The link, and the counts of what has come: by key, all and what was good; questions;
    tokens."""

    def __init__(self, rack: str, table: LanTable) -> None:
        began = time.monotonic()
        self._link = link = LanLink(rack, table)
        self._opened_s = time.monotonic() - began
        self._arrived = [
            link.subscribe(out_key(entry.rack, entry.mailbox)) for entry in table.imports.values()
        ]
        self._questions = link.open_questions(estop_key("*", rack), MAX_UNREAD)
        keys = [out_key(rack, entry.source) for entry in table.exports.values()]
        self._exports = [(key, link.publish(key)) for key in keys]
        self._changes = link.watch_tokens()
        link.declare_token(LAUNCH)
        self._came, self._good, self._asked = Counter[str](), Counter[str](), Counter[str]()
        self._tokens: list[str] = []
        self._sizes = defaultdict[str, set[int]](set)

    def cycle(self) -> None:
        sealer = self._link.sealer
        for take in self._arrived:
            for key, envelope, payload in take():
                self._came[key] += 1
                self._sizes[key].add(len(payload))
                self._good[key] += not isinstance(sealer.open_message(key, envelope, payload), Flaw)
        for asked, reply in self._questions():
            self._asked[asked.key] += 1
            reply(b"answer", attachment=sealer.seal(asked.key, HEAD, b"answer"))
        for key, put in self._exports:
            put(b"content", sealer.seal(key, HEAD, b"content"))
        self._tokens += [
            f"{rack} {'came' if is_there else 'went'}" for rack, _, is_there in self._changes()
        ]

    def state(self) -> dict[str, Any]:
        flaws = {flaw.name: count for flaw, count in self._link.sealer.flaws.items()}
        sizes = {key: sorted(found) for key, found in self._sizes.items()}
        counts = {"came": self._came, "good": self._good, "asked": self._asked, "sizes": sizes}
        own = {"connected": bool(self._link.session.info.peers_zid()), "opened_s": self._opened_s}
        return {**counts, "flaws": flaws, "tokens": self._tokens, **own}


def serve(cycle: Callable[[], None], state: Callable[[], dict[str, Any]], period_s: float) -> None:
    """Cycle until stdin ends; answer each line there with the state, as JSON."""
    due = time.monotonic()
    while True:
        if not select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()))[0]:
            cycle()
            due = time.monotonic() + period_s
        elif sys.stdin.readline():
            sys.stdout.write(json.dumps(state()) + "\n")
            sys.stdout.flush()
        else:
            return


def main(rack: str, table: str) -> None:
    home = Home(rack, LanTable.model_validate(json.loads(table)))
    serve(home.cycle, home.state, PERIOD_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
