"""Racks on a network: round trips, ages, bytes on the wire, and the time to see a death, by their
number and rate.

Machines are network namespaces of this one, so all of them share its cores. A coordinator exchanges
with all others, as in a cell. Each "rack" is one process: the network link, envelopes and seals of
a rack's adapter, with its priority, and cycles on a grid of its own; the boards of a rack are left
out.
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.cyclictest import (
    CYCLICTEST,
    WakeGrid,
    absent_cyclictest,
    cyclictest,
    permits_fifo,
)
from rack.tools.lab.benches.harness import Absent, absent_package, turns
from rack.tools.lab.benches.lan_ends import COORDINATOR
from rack.tools.lab.benches.lan_figures import LanFigures, Point, Steadiness
from rack.tools.lab.benches.lan_group import HEAD_START_NS, Group
from rack.tools.lab.benches.lan_machine import ENDS, TCP, TLS
from rack.tools.lab.benches.network import Lab

COUNTS = (1, 2, 4, 8, 16, 32)
RATES_HZ = (1.0, 10.0, 50.0)
PRIORITY = 60
IDLE_S = 2.0
"""Time for which nobody sends, to see what links cost that only live."""
DEATHS = 4
"""Cables pulled, and processes killed, of one contestant in one round, at most."""
LAUNCH_S = 0.7
"""About how long the two processes of a machine take to start."""
DISTURBED_HZ = 10.0
ENDLESS = 1_000_000
"""Rate of the exchange meanwhile, and a number of cycles that nobody waits for."""
WITHOUT_LIVELINESS = ("UDP",)
PACKAGES = ((TLS, "cryptography"), (TLS, "zenoh"), (TCP, "zenoh"), ("cyclonedds", "cyclonedds"))


@dataclass(frozen=True)
class LanRuns:
    """What to measure: numbers of racks, rates, the time at each, rounds, and the share of packets
    that get lost."""

    counts: Sequence[int]
    rates_hz: Sequence[float]
    seconds: float
    rounds: int
    loss: float


def measure(runs: LanRuns, progress: Progress) -> LanFigures:
    """Measure every contestant at each number of racks, by turns. Raises `Failure`."""
    absent = [one for each in PACKAGES for one in absent_package(*each)]
    contestants = [who for who in ENDS if who not in [one.who for one in absent]]
    lacks = absent_cyclictest()
    absent += lacks
    bench = LanBench(runs)
    progress.total(
        sum(bench.cost_s(count) for count in runs.counts) * len(contestants) * runs.rounds
    )
    for count in runs.counts:
        with Lab(count + 1) as lab:
            for machine in range(1, count + 1):
                lab.lose(machine, runs.loss)
            for _, who in turns(contestants, runs.rounds):
                progress.begin(f"{count} racks: {who}")
                try:
                    bench.measure(lab, who)
                    ended = "done"
                except Failure as failure:
                    # The others count all the same.
                    ended = str(failure)
                    absent.append(Absent(f"{who} with {count} racks", ended))
                progress.end(bench.cost_s(count), ended)
            if not lacks:
                bench.wake(count)
    return bench.figures(absent)


class LanBench:
    """Collects what is found."""

    def __init__(self, runs: LanRuns) -> None:
        self._runs = runs
        self._priority = PRIORITY if permits_fifo() else 0
        self._values: defaultdict[Point, list[float]] = defaultdict(list)
        self._steady: dict[str, Steadiness] = {}

    def cost_s(self, count: int) -> float:
        """About how long one contestant takes with so many racks."""
        windows = 2 * len(self._runs.rates_hz) * (self._runs.seconds + HEAD_START_NS * 1e-9)
        return windows + IDLE_S + LAUNCH_S * (count + 1) + DEATHS

    def _cycles(self, rate_hz: float) -> int:
        return max(1, round(self._runs.seconds * rate_hz))

    def measure(self, lab: Lab, who: str) -> None:
        """Measure one contestant once, with a rack on every machine of the lab but the first."""
        with Group(lab, who, echoes=True, priority=self._priority) as group:
            for rate_hz in self._runs.rates_hz:
                found = group.run(rate_hz, self._cycles(rate_hz))
                self._note(group, "round trip", "us", found[COORDINATOR].us, rate_hz)
        with Group(lab, who, echoes=False, priority=self._priority) as group:
            self._exchange(group)
            if who not in WITHOUT_LIVELINESS:
                self._disturb(group)

    def _exchange(self, group: Group) -> None:
        """Measure ages, and bytes on the wire."""
        steady = self._steady.setdefault(group.who, Steadiness())
        start_s = time.monotonic()
        idle_from = _wire_bytes(group.lab)
        group.idle(IDLE_S)
        idle = (_wire_bytes(group.lab) - idle_from) / (time.monotonic() - start_s)
        self._note(group, "on the wire", "kB/s", [idle * 1e-3])
        for rate_hz in self._runs.rates_hz:
            before = _wire_bytes(group.lab)
            before_s = time.monotonic()
            cycles = self._cycles(rate_hz)
            found = group.run(rate_hz, cycles)
            # A window is idle before its first cycle and after its last one.
            sent = _wire_bytes(group.lab) - before - idle * (time.monotonic() - before_s)
            kilobytes = (idle + sent * rate_hz / cycles) * 1e-3
            ages_ms = [us * 1e-3 for one in found for us in one.us]
            each_us = found[COORDINATOR].processor_us / (cycles * group.racks)
            self._note(group, "age", "ms", ages_ms, rate_hz)
            self._note(group, "on the wire", "kB/s", [kilobytes], rate_hz)
            self._note(group, "processor", "us", [each_us], rate_hz)
            steady.missing += sum(one.missing for one in found)
            steady.taken += sum(len(one.us) for one in found)
        steady.false_deaths += group.false_deaths
        steady.rack_s += group.racks * (time.monotonic() - start_s)

    def _disturb(self, group: Group) -> None:
        """Pull cables, then kill processes, while they exchange."""
        group.begin(DISTURBED_HZ, ENDLESS)
        for turn in range(DEATHS):
            lost_ms, back_ms = group.pull_cable(1 + turn % group.racks)
            self._note(group, "cable pulled", "ms", [lost_ms])
            self._note(group, "plugged in", "ms", [back_ms])
        for machine in range(1, min(DEATHS, group.racks) + 1):
            self._note(group, "killed", "ms", [group.kill(machine)])

    def wake(self, count: int) -> None:
        """Measure how late this machine wakes `cyclictest` at the highest rate, on all cores."""
        rate_hz = max(self._runs.rates_hz)
        grid = WakeGrid.at(os.sched_getaffinity(0), rate_hz, self._runs.seconds, PRIORITY)
        point = Point("wake", count, rate_hz, CYCLICTEST, "us")
        self._values[point].extend(cyclictest(grid).tolist())

    def _note(
        self, group: Group, what: str, unit: str, values: Sequence[float], rate_hz: float = 0.0
    ) -> None:
        self._values[Point(what, group.racks, rate_hz, group.who, unit)].extend(values)

    def figures(self, absent: Sequence[Absent]) -> LanFigures:
        """Return all that was found."""
        found = {point: tuple(values) for point, values in self._values.items() if values}
        return LanFigures(found, self._steady, self._runs.loss, self._priority > 0, tuple(absent))


def _wire_bytes(lab: Lab) -> int:
    """Return the bytes that have passed the cable of the coordinator, both ways."""
    traffic = lab.traffic()[COORDINATOR]
    return traffic.sent_bytes + traffic.received_bytes
