"""Processes in real time that lose their cores anywhere, for 5 to 45 ms: none of this counts as a
fault."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable, Iterator
from types import FrameType

import pytest

from rack.backplane.layout import PROTOCOLS, Protocol
from rack.backplane.mailbox.protocols import open_observer
from tests.backplane.bus import CLOCK_NS, NAME
from tests.link import Link, MakeLink, ReadingTask, WritingTask, links
from tests.processes import FORKS, exit_status, fork

pytestmark = [pytest.mark.thorough, pytest.mark.filterwarnings(FORKS)]
SECONDS = 2.0
ROUND = 16
"""Slots that a writer fills in 40 ms, while its reader is stalled."""
STALLS = 12
"""Stalls, at least, that each process must have had: sent in a little more than half of the
time."""


@pytest.fixture
def link(rack_name: str) -> Iterator[MakeLink]:
    with links(rack_name) as make:
        yield make


class Stalls:
    """Stops this process at any instruction: a timer's signal, whose handler sleeps."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)
        self.count = 0
        signal.signal(signal.SIGALRM, self._stall)
        self._arm()

    def _arm(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, self._rng.uniform(0.005, 0.06))

    def _stall(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        time.sleep(self._rng.uniform(0.005, 0.045))
        self._arm()


def cycle(
    every: int, epoch: int, seed: int, work: Callable[[int, Callable[[], int]], object]
) -> bool:
    """Do `work` on the grid until the time is over; missed releases are skipped. Return whether
    there were stalls."""

    def now() -> int:
        return (time.monotonic_ns() - epoch) // CLOCK_NS

    stalls, last = Stalls(seed), -1
    while (tick := now()) * CLOCK_NS < SECONDS * 1e9:
        release = tick - tick % every
        if release > last:
            last = release
            work(release, now)
        time.sleep(max(0, epoch + (last + every) * CLOCK_NS - time.monotonic_ns()) * 1e-9)
    signal.setitimer(signal.ITIMER_REAL, 0)
    return stalls.count >= STALLS


def run(rack: Link, seed: int) -> None:
    """Run a writer and a reader of a mailbox, each in its process, and their stalls."""
    rack.writer.close()
    epoch = time.monotonic_ns() + 50_000_000

    def write() -> bool:
        writer = WritingTask(rack.segment)
        # The time is asked for in the cycle, and a stall may lie between that and the write.
        return cycle(writer.every, epoch, seed, lambda tick, now: writer.cycle(tick, now()))

    def read() -> bool:
        reader = ReadingTask(rack.segment)
        return cycle(reader.every, epoch, seed + 1, lambda tick, now: reader.cycle(tick))

    assert [exit_status(pid) for pid in (fork(write), fork(read))] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize(("rates", "depth"), [((1, 8), ROUND), ((8, 1), 1024)])
def test_stalls_of_writer_and_reader_raise_no_alarm(
    link: MakeLink, protocol: Protocol, rates: tuple[int, int], depth: int
) -> None:
    rack = link(protocol, rates, depth=depth)
    run(rack, seed=31 * rates[0] + rates[1])
    assert rack.alarms("reader") == []
    assert rack.alarms("writer") == []
    observer = open_observer(rack.segment, NAME)
    observer.peek()
    assert observer.serial > 100 / rates[0]
