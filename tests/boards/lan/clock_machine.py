"""One machine of a comparison of clocks: an adapter's clocks on a backplane of their own, without a
rack around them.

`python -m tests.boards.lan.clock_machine NAME OTHER TABLE TRIPS` prints, as JSON, what it has found
of the other's clock once it has taken so many round trips, and its own grid; it ends when its stdin
is closed.
"""

from __future__ import annotations

import json
import select
import sys
import time

from rack.backplane.layout import Layout
from rack.backplane.segment import Segment, unlink
from rack.backplane.words import System
from rack.boards.lan.clocks import Clocks
from rack.boards.lan.config import LanTable
from rack.boards.lan.envelope import Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.link import LanLink
from rack.boards.lan.peers import Peers

CYCLE_S = 0.005
CLOCK_NS, PERIOD_NS = 2_500_000, 1_250_000
"""Twice as fast as time."""


def main(name: str, other: str, table: str, trips: int) -> None:
    """Compare clocks until stdin is closed."""
    link = LanLink(name, LanTable.model_validate(json.loads(table)))
    segment = Segment.create(Layout(name, CLOCK_NS, (), ()), "")
    try:
        segment.words[System.PERIOD_NS] = PERIOD_NS
        segment.words[System.EPOCH_NS] = epoch_ns = time.monotonic_ns()
        peers = Peers([other])
        clocks = Clocks(segment, peers, epoch_ns, OwnGrid(segment, 1))
        clocks.open(link, Sealer())
        peers.watch(link.watch_alive(), is_lockstep=False)
        link.declare_alive(epoch_ns)
        has_said = False
        while not select.select([sys.stdin], [], [], CYCLE_S)[0]:
            peers.look(0)
            clocks.exchange()
            if clocks.taken >= trips and not has_said:
                has_said = True
                tick = (time.monotonic_ns() - epoch_ns) // PERIOD_NS
                clocks.fill(out := Found(), other, tick)
                sys.stdout.write(
                    json.dumps({"epoch_ns": epoch_ns, "tick": tick, **vars(out)}) + "\n"
                )
                sys.stdout.flush()
    finally:
        link.close()
        unlink(name)


class Found:
    """What the mailbox of a peer holds."""


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
