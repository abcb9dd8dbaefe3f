"""Two racks on a network that loses packets, is cut, and where one is killed: nothing is lost
unseen, or taken twice.

In real time, with TLS, each rack on a machine of its own.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.levels.peer import Presence
from rack.tools.network.certificates import make_credentials
from tests.boards.lan.racks import RackProcess, rack_text
from tests.machine import needs_fifo, needs_lab
from tests.network_lab import LINK, NET, Lab
from tests.processes import BOUND_S, wait_until

pytestmark = [pytest.mark.alone, pytest.mark.thorough, needs_lab, needs_fifo]

PORT = 7447
LEASE_TICKS = 200
"""500 ms, the default, in ticks of 2.5 ms."""
KEEP_ALIVE_TICKS = LEASE_TICKS // 4
CYCLE_TICKS = 8
AWAY_TICKS = 600
LOSS = 0.05
RETRANSMIT = "rto_min 5ms"
"""Shortest time after which TCP sends a packet again. Linux waits 200 ms; see
configs/cell/scale.md."""


class Counts(NamedTuple):
    """What a rack has counted of its import, and how it sees the other rack."""

    number: int
    taken: int
    missing: int
    disordered: int
    repeated: int
    late: int
    refused: int
    unknown_launch: int
    superseded: int
    presence: Presence
    launches: int
    losses: int
    since: int

    @property
    def accounted(self) -> int:
        """Messages up to the newest of which it is known what became of them."""
        return self.taken + self.missing + self.late + self.superseded


class LabRack:
    """One of two racks, on its machine of the lab."""

    def __init__(self, lab: Lab, machine: int, names: tuple[str, str], folder: Path) -> None:
        self.name, self._other = names[machine], names[1 - machine]
        self._popen: Callable[..., subprocess.Popen[str]] = partial(lab.popen, machine)
        self._config = folder / f"{self.name}.toml"
        endpoint = f"tls/{lab.address(0)}:{PORT}"
        listen, connect = (endpoint, []) if machine == 0 else ("", [endpoint])
        certificates = f'certificates = "{folder}"'
        self._config.write_text(
            rack_text(self.name, listen, connect, self._other, lan=certificates)
        )
        self.process: RackProcess

    def start(self) -> None:
        """Launch it."""
        self.process = RackProcess(self._config, None, "clock.mode=realtime", popen=self._popen)
        self.process.await_event("start")
        self.segment = Segment.attach(self.name)

    def stop(self) -> None:
        """End it in order."""
        self.process.send(signal.SIGTERM)
        assert self.process.outcome()["cause"] == "stopped"

    @property
    def tick(self) -> int:
        """The tick that it is in."""
        return self.segment.words[System.TICK]

    def _peek(self, mailbox: str) -> Any:
        return open_observer(self.segment, mailbox).peek().message

    def counts(self) -> Counts:
        """Return what it has counted so far."""
        entry = self._peek("lan.status").import_other
        peer = self._peek(f"lan.peer_{self._other.replace('-', '_')}")
        counted = [int(entry[name]) for name in Counts._fields[:9]]
        seen = Presence(int(peer.presence)), int(peer.launches), int(peer.losses), int(peer.since)
        return Counts(*counted, *seen)

    def heard(self) -> tuple[int, int]:
        """Return the count last heard from the other rack, and how often one was not above that
        before it."""
        status = self._peek("echo.status")
        return int(status.count), int(status.backward)

    def await_messages(self, number: int) -> None:
        """Wait until it has taken so many more."""
        until = self.counts().taken + number
        wait_until(lambda: self.counts().taken >= until)

    def await_presence(self, presence: Presence) -> Counts:
        """Wait until the other rack is there, or lost."""
        wait_until(lambda: self.counts().presence is presence)
        return self.counts()


@pytest.fixture(scope="module")
def lab() -> Iterator[Lab]:
    with Lab(2) as lab:
        for machine in range(len(lab)):
            route = f"ip route change {NET}.0/24 dev {LINK} src {lab.address(machine)} {RETRANSMIT}"
            assert lab.popen(machine, route.split()).wait(BOUND_S) == 0
        yield lab


@pytest.fixture(scope="module")
def racks(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LabRack, LabRack]]:
    folder = tmp_path_factory.mktemp("racks")
    names = f"disturbed-{folder.stat().st_ino}-a", f"disturbed-{folder.stat().st_ino}-b"
    make_credentials(
        folder / "set", {name: [lab.address(k)] for k, name in enumerate(names)}, days=1
    )
    pair = LabRack(lab, 0, names, folder / "set"), LabRack(lab, 1, names, folder / "set")
    with ExitStack() as stack:
        for rack in pair:
            rack.start()
            stack.callback(rack.stop)
        for rack in pair:
            rack.await_messages(5)
        yield pair


def test_lost_packets_lose_no_message_and_no_rack(lab: Lab, racks: tuple[LabRack, LabRack]) -> None:
    before = [rack.counts() for rack in racks]
    lab.lose(1, LOSS)
    for rack in racks:
        rack.await_messages(75)
    lab.lose(1, 0.0)
    for rack, first in zip(racks, before, strict=True):
        now = rack.counts()
        assert (now.missing, now.losses, now.launches) == (
            first.missing,
            first.losses,
            first.launches,
        )
        assert (now.refused, now.unknown_launch, now.repeated, now.disordered) == (0, 0, 0, 0)
        # All that were sent until the newest that was taken.
        assert now.number - first.number == now.accounted - first.accounted
        assert rack.heard()[1] == 0


def test_a_pulled_cable_is_seen_within_the_lease_by_both_and_nothing_old_counts_as_new(
    lab: Lab, racks: tuple[LabRack, LabRack]
) -> None:
    before = [rack.counts() for rack in racks]
    lab.unplug(1)
    pulled = [rack.tick for rack in racks]
    for rack, tick in zip(racks, pulled, strict=True):
        lost = rack.await_presence(Presence.LOST)
        # The lease begins with the last sign of life, and is looked at as often as signs are due.
        assert lost.since - tick <= LEASE_TICKS + KEEP_ALIVE_TICKS + CYCLE_TICKS
    for rack, tick in zip(racks, pulled, strict=True):
        wait_until(lambda rack=rack, tick=tick: rack.tick > tick + AWAY_TICKS)
    lab.plug(1)
    for rack, first in zip(racks, before, strict=True):
        rack.await_presence(Presence.THERE)
        rack.await_messages(5)
        now = rack.counts()
        assert (now.launches, now.losses) == (first.launches, first.losses + 1)
        # One each may have waited for the comparison of clocks, at either end of the time away.
        assert abs((now.number - first.number) - (now.accounted - first.accounted)) <= 2
        # Sent meanwhile, and gone with the connection.
        assert now.missing > first.missing
        assert (now.refused, now.repeated) == (0, 0)
        assert rack.heard()[1] == 0


def test_a_killed_rack_is_lost_and_its_next_launch_is_distinguished(
    racks: tuple[LabRack, LabRack],
) -> None:
    killed, other = racks[1], racks[0]
    before, count = other.counts(), other.heard()[0]
    killed.process.end()
    tick = other.tick
    lost = other.await_presence(Presence.LOST)
    assert lost.since - tick <= LEASE_TICKS + KEEP_ALIVE_TICKS + CYCLE_TICKS
    killed.start()
    now = other.await_presence(Presence.THERE)
    other.await_messages(5)
    assert (now.launches, now.losses) == (before.launches + 1, before.losses + 1)
    # It counts from the start again: once, for the reader, it went back.
    assert other.heard()[0] < count
    assert other.heard()[1] == 1
    assert other.counts().missing == before.missing
    killed.await_messages(5)
    assert killed.counts()[-4:-1] == (Presence.THERE, 1, 0)
