"""Whether this machine is fit for real time, and up to which rate: a rack next to `cyclictest`.

The rack runs at each rate in turn. Only its fastest board changes: the clock follows its rate, and
every other board gets the cycle that is closest to its own. `cyclictest` sleeps to the same grid on
the same core in the same minutes. A machine that wakes it a cycle late, as a hypervisor does that
takes the core away, breaks deadlines that no program could keep.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from itertools import takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rack.backplane.process import cores_kept_awake
from rack.boards.config import RackConfig, load
from rack.boards.config.layout import obtained_core
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.console.tables import Blocks
from rack.tools.lab.benches.cyclictest import (
    CYCLICTEST,
    WakeGrid,
    absent_cyclictest,
    cyclictest,
    late_share,
    permits_fifo,
)
from rack.tools.lab.benches.harness import Absent, Comparison, Sample, interleaved, shown
from rack.tools.lab.benches.observed import (
    UNVIEWED,
    count_cycles,
    endless,
    lateness_us,
    record,
)

RATES_HZ = (400.0, 500.0, 1000.0, 2000.0)
PERMITTED = 0.001
"""Share of a board's cycles that may be missed beyond those of the machine, and share of
`cyclictest`'s wakes that may be late by a cycle, for a rate to be held."""
STEP_MS = 0.5
"""Longest time step of the simulated arm, that of the bundled racks."""
LAUNCH_S = 3.0
AWAKE = ", idle cores awake"
"""Ends the name of the rack that runs while idle cores are held awake."""


def at_rate(config: RackConfig, rate_hz: float) -> RackConfig:
    """Return a rack whose fastest board cycles at `rate_hz`, at every tick; the others keep their
    cycles, in ms.

    A plan of that board still takes as long.

    Raises:
        Failure: If the rack has no board at every tick.
    """
    fastest = [name for name in config.board if config.every(name) == 1]
    if not fastest:
        raise Failure(
            f"rack '{config.name}': no board cycles at every tick of its clock, so none has a rate"
            " to raise"
        )
    period_ms = 1e3 / rate_hz
    scale = config.clock.period_ms / period_ms
    boards = {}
    for name, board in endless(config).board.items():
        changes: dict[str, Any] = {"every": max(1, round(config.every(name) * scale))}
        if name in fastest:
            changes = {"every": 1, "within_cycles": max(1, round(board.within_cycles * scale))}
        boards[name] = board.model_copy(update={**changes, "rate_hz": None})
    robot = config.robot
    if robot is not None:
        # Rounded: 2.5 ms / 0.5 ms must be 5, whatever the last bit says.
        robot = robot.model_copy(update={"substeps": math.ceil(round(period_ms / STEP_MS, 6))})
    clock = config.clock.model_copy(
        update={"period_ms": period_ms, "mode": "realtime", "speed": 1.0}
    )
    return config.model_copy(update={"clock": clock, "board": boards, "robot": robot})


@dataclass(frozen=True)
class RateFigures:
    """All runs at one rate.

    Attributes:
        rate_hz: The rate.
        cycles: Cycles of the rack's fastest board that were due.
        missed: Share of them that were missed or skipped.
        late: Share of `cyclictest`'s wakes that were late by a cycle or more; None if it is absent.
        failure: Why a run ended early; empty if none did.
    """

    rate_hz: float
    cycles: int
    missed: float
    late: float | None
    failure: str = ""

    @property
    def reason(self) -> str:
        """Why the rate is not held; empty if it is."""
        late = self.late or 0.0
        if self.failure or late > PERMITTED:
            return self.failure or "the machine is late"
        return "the rack is late" if self.missed - late > PERMITTED else ""

    @property
    def verdict(self) -> str:
        """Whether the rate is held, and if not, why."""
        return f"not held: {self.reason}" if self.reason else "held"


@dataclass(frozen=True)
class Machine(Comparison):
    """The figures of every rate, lowest first, and the lateness of the rack's fastest board `who`
    next to `cyclictest`.
    """

    who: str = ""
    is_fifo: bool = False
    rates: tuple[RateFigures, ...] = ()

    @property
    def highest_hz(self) -> float | None:
        """The highest rate that is held, as all below it are; None if the lowest is not."""
        held = takewhile(lambda one: not one.reason, self.rates)
        return max((one.rate_hz for one in held), default=None)

    @property
    def is_fit(self) -> bool:
        """Whether the machine permits real-time priorities and holds at least the lowest rate."""
        return self.is_fifo and self.highest_hz is not None

    @property
    def verdict(self) -> Iterator[str]:
        """The answer in a few lines: whether the machine is fit, up to which rate, and why not
        beyond.
        """
        highest = self.highest_hz
        if not self.is_fifo:
            yield "not fit for real time: SCHED_FIFO is refused (see `ulimit -r`)"
        elif highest is None:
            yield f"not fit for real time at {self.rates[0].rate_hz:g} Hz or more"
        else:
            yield f"fit for real time up to {highest:g} Hz"
        for one in self.rates:
            late = "" if one.late is None else f", {CYCLICTEST} late in {one.late:.2%}"
            counts = f"missed {one.missed:.2%} of {one.cycles} cycles{late}"
            yield f"{one.rate_hz:g} Hz {one.verdict}; {counts}; {self._worst(one.rate_hz)}"

    def _worst(self, rate_hz: float) -> str:
        samples = ((who, self.sample(_case(rate_hz), who)) for who in (self.who, CYCLICTEST))
        known = (f"{who} {shown(sample.worst)} us" for who, sample in samples if sample)
        return f"worst lateness: {', '.join(known) or 'unknown'}"

    def document(self) -> dict[str, Any]:
        """Return everything as plain data, without the raw values."""
        rates = [{**asdict(one), "held": not one.reason} for one in self.rates]
        return {
            **super().document(),
            "fit": self.is_fit,
            "highest_hz": self.highest_hz,
            "fifo": self.is_fifo,
            "permitted": PERMITTED,
            "rates": rates,
        }

    def blocks(self) -> Blocks:
        """Yield the verdict, then the lateness as a table."""
        yield from self.verdict
        yield ""
        yield from super().blocks()


def _case(rate_hz: float) -> str:
    return f"{rate_hz:g} Hz"


def measure(
    name: str,
    rates_hz: Sequence[float],
    seconds: float,
    rounds: int,
    share: bool,
    progress: Progress,
) -> Machine:
    """Run a rack at every rate, by turns with `cyclictest` on the core of its fastest board.

    Args:
        name: Config of the rack, by name or path.
        rates_hz: Rates of its fastest board.
        seconds: Time of each run.
        rounds: Number of runs of each contestant.
        share: Whether cores may be shared with another rack.
        progress: Told of each rate.

    Raises:
        Failure: If the rack has no board at every tick, or `cyclictest` fails.
    """
    config = load(name, [f"name=bench-{os.getpid()}", *UNVIEWED])
    racks = {rate_hz: at_rate(config, rate_hz) for rate_hz in sorted(set(rates_hz))}
    fastest = next(board for board in config.board if config.every(board) == 1)
    core = obtained_core(config.board[fastest].core)
    who = f"'{fastest}' of {Path(name).stem}"
    absent = [*absent_cyclictest()]
    is_compared = not absent
    with cores_kept_awake() as refusal:
        if refusal:
            absent.append(Absent(who + AWAKE, refusal))
    each_s = rounds * (3 * seconds + 2 * LAUNCH_S)
    progress.total(len(racks) * each_s)
    rates = []
    samples = []
    for rate_hz, rack in racks.items():
        progress.begin(_case(rate_hz))
        priority = config.board[fastest].priority or 1
        wakes = max(1, round(seconds * rate_hz))
        grid = WakeGrid(core, round(1e9 / rate_hz), wakes, priority)
        contestants: dict[str, Callable[[], RackRun]] = {
            who: partial(_run, rack, fastest, seconds, share, awake=False)
        }
        if not refusal:
            contestants[who + AWAKE] = partial(_run, rack, fastest, seconds, share, awake=True)
        if is_compared:
            contestants[CYCLICTEST] = partial(_sleep, grid)
        found = interleaved(contestants, rounds)
        for one, each in found.items():
            late_us = np.concatenate([run.late_us for run in each])
            if len(late_us):
                samples.append(Sample(_case(rate_hz), one, tuple(late_us.tolist()), "us"))
        cycles = count_cycles(run.counts for run in found[who])
        rates.append(
            RateFigures(
                rate_hz=rate_hz,
                cycles=cycles.due,
                missed=cycles.share,
                late=late_share([run.late_us for run in found.get(CYCLICTEST, ())], grid.period_ns),
                failure=next(filter(None, (run.failure for run in found[who])), ""),
            )
        )
        progress.end(each_s, rates[-1].verdict)
    return Machine(
        name="machine",
        title=f"lateness: from grid point to start, on core {core}",
        samples=tuple(samples),
        baselines=dict.fromkeys(map(_case, racks), CYCLICTEST),
        absent=tuple(absent),
        conclusion=compare_idle_cores(samples, who),
        who=who,
        is_fifo=permits_fifo(),
        rates=tuple(rates),
    )


class RackRun(NamedTuple):
    """One run of a contestant: the lateness of its wakes, us; of a rack also the counts of its
    board's cycles, and why it ended early.
    """

    late_us: np.ndarray
    counts: Mapping[str, int] = MappingProxyType({})
    failure: str = ""


def _run(rack: RackConfig, board: str, seconds: float, share: bool, awake: bool) -> RackRun:
    with (
        TemporaryDirectory(prefix="rack-bench-") as folder,
        cores_kept_awake() if awake else nullcontext(),
    ):
        result, recording = record(rack, seconds, Path(folder), share)
        late_us = lateness_us(recording, board)
        return RackRun(late_us, result.tasks[board], result.outcome.failure)


def _sleep(grid: WakeGrid) -> RackRun:
    return RackRun(cyclictest(grid))


def compare_idle_cores(samples: Sequence[Sample], who: str) -> str:
    """Return which `clock.idle_cores` suits this machine, with the figures that say so; empty
    unless both were measured.

    Lost wake-ups decide if the counts are apart by more than chance, two standard deviations of it;
    if not, the worst wake-up: a core that its host takes away shows there first.
    """
    found = []
    for setting, name in (("sleep", who), ("awake", who + AWAKE)):
        own = [sample for sample in samples if sample.who == name]
        if not own:
            return ""
        lost = sum(us >= 1e6 / float(one.case.split()[0]) for one in own for us in one.values)
        worst_us = max(one.worst for one in own)
        words = f'"{setting}", {lost} wake-ups late by a period, worst {shown(worst_us)} us'
        found.append((lost, worst_us, words))
    total = sum(lost for lost, _, _ in found)
    is_apart = abs(found[0][0] - found[1][0]) > 2.0 * math.sqrt(total)
    best, other = sorted(found, key=lambda one: one[0] if is_apart else one[1])
    return f"clock.idle_cores that suits this machine: {best[2]}; with {other[2]}"
