"""Fitness of this machine for real time: a rack and `cyclictest` are compared at several rates.

Only the fastest board of the rack changes its rate, and the clock follows it. Every other board
keeps the cycle time that is closest to its normal one. `cyclictest` sleeps to the same grid on the
same core in the same minutes. If the machine wakes `cyclictest` a cycle late, for example because a
hypervisor takes the core away, deadlines are missed that no program could keep.
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

from rack.backplane.process import keep_cores_awake
from rack.boards.config import RackConfig, load
from rack.boards.config.layout import find_core
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.console.tables import Blocks
from rack.tools.lab.benches.cyclictest import (
    CYCLICTEST,
    WakeGrid,
    compute_late_share,
    find_missing_cyclictest,
    is_fifo_permitted,
    run_cyclictest,
)
from rack.tools.lab.benches.harness import (
    Absent,
    Comparison,
    Sample,
    call_interleaved,
    format_value,
)
from rack.tools.lab.benches.observed import (
    UNVIEWED_SETTINGS,
    compute_lateness_us,
    count_cycles,
    record_rack,
    remove_run_end,
)

RATES_HZ = (400.0, 500.0, 1000.0, 2000.0)
MAX_LATE_SHARE = 0.001
"""Largest share of late cycles at which a rate counts as held.

It applies to the wake-ups of `cyclictest` that are late by a cycle or more, and to the cycles that
a board misses in addition to these.
"""
MAX_STEP_MS = 0.5
"""Longest time step of the simulated arm, ms, as in the bundled racks."""
LAUNCH_S = 3.0
AWAKE_SUFFIX = ", idle cores awake"
"""Suffix of the name of the rack that runs with idle cores kept awake."""


def change_rate(config: RackConfig, rate_hz: float) -> RackConfig:
    """Return a config whose fastest board runs at `rate_hz`, once per tick.

    The other boards keep their cycle times, and plans of the fastest board keep their time limit.

    Raises:
        Failure: If the rack has no board at every tick.
    """
    fastest = [name for name in config.board if config.find_period(name) == 1]
    if not fastest:
        raise Failure(
            f"rack '{config.name}': no board cycles at every tick of its clock, therefore no rate"
            " can be raised"
        )
    period_ms = 1e3 / rate_hz
    scale = config.clock.period_ms / period_ms
    boards = {}
    for name, board in remove_run_end(config).board.items():
        changes: dict[str, Any] = {"every": max(1, round(config.find_period(name) * scale))}
        if name in fastest:
            changes = {"every": 1, "within_cycles": max(1, round(board.within_cycles * scale))}
        boards[name] = board.model_copy(update={**changes, "rate_hz": None})
    robot = config.robot
    if robot is not None:
        # Rounding makes 2.5 ms / 0.5 ms exactly 5.
        robot = robot.model_copy(update={"substeps": math.ceil(round(period_ms / MAX_STEP_MS, 6))})
    clock = config.clock.model_copy(
        update={"period_ms": period_ms, "mode": "realtime", "speed": 1.0}
    )
    return config.model_copy(update={"clock": clock, "board": boards, "robot": robot})


@dataclass(frozen=True)
class RateFigures:
    """Results of all runs at one rate.

    The rate is held if no run failed, and if neither the share of `cyclictest`'s late wake-ups nor
    the share of cycles that the rack missed in addition exceeds `MAX_LATE_SHARE`.

    Attributes:
        rate_hz: The rate.
        cycles: Number of cycles of the rack's fastest board that were due.
        missed: Share of these cycles that were missed or skipped.
        late: Share of `cyclictest`'s wake-ups that were late by a cycle or more. None without
            `cyclictest`.
        failure: Reason why a run ended early. Empty if none did.
    """

    rate_hz: float
    cycles: int
    missed: float
    late: float | None
    failure: str = ""

    @property
    def reason(self) -> str:
        """Reason why the rate is not held. Empty if it is held."""
        late = self.late or 0.0
        if self.failure or late > MAX_LATE_SHARE:
            return self.failure or "the machine is late"
        return "the rack is late" if self.missed - late > MAX_LATE_SHARE else ""

    @property
    def verdict(self) -> str:
        """Verdict on the rate: "held", or "not held" followed by the reason."""
        return f"not held: {self.reason}" if self.reason else "held"


@dataclass(frozen=True)
class MachineComparison(Comparison):
    """Comparison of the lateness of a board with `cyclictest`, with a verdict on the machine.

    Attributes:
        who: Name of the rack's fastest board.
        is_fifo: Whether real-time priorities are permitted.
        rates: Results at every rate, lowest first.
    """

    who: str = ""
    is_fifo: bool = False
    rates: tuple[RateFigures, ...] = ()

    @property
    def highest_hz(self) -> float | None:
        """Highest rate up to which every rate is held. None if the lowest rate is not held."""
        held_rates = takewhile(lambda rate: not rate.reason, self.rates)
        return max((rate.rate_hz for rate in held_rates), default=None)

    @property
    def is_fit(self) -> bool:
        """Whether the machine permits real-time priorities and holds at least the lowest rate."""
        return self.is_fifo and self.highest_hz is not None

    @property
    def verdict_lines(self) -> Iterator[str]:
        """Lines with the highest rate for which the machine is fit, and the result of each rate."""
        highest = self.highest_hz
        if not self.is_fifo:
            yield "not fit for real time: SCHED_FIFO is refused (see `ulimit -r`)"
        elif highest is None:
            yield f"not fit for real time at {self.rates[0].rate_hz:g} Hz or more"
        else:
            yield f"fit for real time up to {highest:g} Hz"
        for rate in self.rates:
            late = "" if rate.late is None else f", {CYCLICTEST} late in {rate.late:.2%}"
            counts = f"missed {rate.missed:.2%} of {rate.cycles} cycles{late}"
            yield (
                f"{rate.rate_hz:g} Hz {rate.verdict}; {counts}; "
                f"{self._format_worst_lateness(rate.rate_hz)}"
            )

    def _format_worst_lateness(self, rate_hz: float) -> str:
        """Format the worst lateness of the board and of `cyclictest` at a rate."""
        samples = (
            (who, self.find_sample(_format_case(rate_hz), who)) for who in (self.who, CYCLICTEST)
        )
        known = (f"{who} {format_value(sample.worst)} us" for who, sample in samples if sample)
        return f"worst lateness: {', '.join(known) or 'unknown'}"

    def to_document(self) -> dict[str, Any]:
        """Convert the comparison and the verdict to plain data, without the raw values."""
        rates = [{**asdict(rate), "held": not rate.reason} for rate in self.rates]
        return {
            **super().to_document(),
            "fit": self.is_fit,
            "highest_hz": self.highest_hz,
            "fifo": self.is_fifo,
            "permitted": MAX_LATE_SHARE,
            "rates": rates,
        }

    def format_blocks(self) -> Blocks:
        """Yield the verdict, then the lateness as a table."""
        yield from self.verdict_lines
        yield ""
        yield from super().format_blocks()


def _format_case(rate_hz: float) -> str:
    """Format a rate as the name of its case."""
    return f"{rate_hz:g} Hz"


def measure_machine(
    name: str,
    rates_hz: Sequence[float],
    seconds: float,
    rounds: int,
    share: bool,
    progress: Progress,
) -> MachineComparison:
    """Run a rack at every rate, alternately with `cyclictest` on the core of its fastest board.

    Args:
        name: Config of the rack, by name or path.
        rates_hz: Rates of its fastest board.
        seconds: Time of each run, s.
        rounds: Number of runs of each contestant.
        share: Whether cores may be shared with another rack.
        progress: Shows each rate.

    Returns:
        Comparison of all rates.

    Raises:
        Failure: If the rack has no board at every tick, or `cyclictest` fails.
    """
    config = load(name, [f"name=bench-{os.getpid()}", *UNVIEWED_SETTINGS])
    racks = {rate_hz: change_rate(config, rate_hz) for rate_hz in sorted(set(rates_hz))}
    fastest = next(board for board in config.board if config.find_period(board) == 1)
    core = find_core(config.board[fastest].core)
    label = f"'{fastest}' of {Path(name).stem}"
    absent = [*find_missing_cyclictest()]
    is_compared = not absent
    with keep_cores_awake() as refusal:
        if refusal:
            absent.append(Absent(label + AWAKE_SUFFIX, refusal))
    each_s = rounds * (3 * seconds + 2 * LAUNCH_S)
    progress.set_total(len(racks) * each_s)
    rates = []
    samples = []
    for rate_hz, rack in racks.items():
        progress.begin_run(_format_case(rate_hz))
        priority = config.board[fastest].priority or 1
        wakes = max(1, round(seconds * rate_hz))
        grid = WakeGrid(core, round(1e9 / rate_hz), wakes, priority)
        contestants: dict[str, Callable[[], RackRun]] = {
            label: partial(_run_rack, rack, fastest, seconds, share, awake=False)
        }
        if not refusal:
            contestants[label + AWAKE_SUFFIX] = partial(
                _run_rack, rack, fastest, seconds, share, awake=True
            )
        if is_compared:
            contestants[CYCLICTEST] = partial(_run_cyclictest, grid)
        runs = call_interleaved(contestants, rounds)
        for contestant, its_runs in runs.items():
            late_us = np.concatenate([run.late_us for run in its_runs])
            if len(late_us):
                samples.append(
                    Sample(_format_case(rate_hz), contestant, tuple(late_us.tolist()), "us")
                )
        cycles = count_cycles(run.counts for run in runs[label])
        rates.append(
            RateFigures(
                rate_hz=rate_hz,
                cycles=cycles.due,
                missed=cycles.share,
                late=compute_late_share(
                    [run.late_us for run in runs.get(CYCLICTEST, ())], grid.period_ns
                ),
                failure=next(filter(None, (run.failure for run in runs[label])), ""),
            )
        )
        progress.end_run(each_s, rates[-1].verdict)
    return MachineComparison(
        name="machine",
        title=f"lateness: from grid point to start, on core {core}",
        samples=tuple(samples),
        baselines=dict.fromkeys(map(_format_case, racks), CYCLICTEST),
        absent=tuple(absent),
        conclusion=compare_idle_cores(samples, label),
        who=label,
        is_fifo=is_fifo_permitted(),
        rates=tuple(rates),
    )


class RackRun(NamedTuple):
    """One run of a contestant.

    Attributes:
        late_us: Lateness of its wake-ups, us.
        counts: Counts of the board's cycles. Empty for `cyclictest`.
        failure: Reason why a rack's run ended early. Empty if it did not.
    """

    late_us: np.ndarray
    counts: Mapping[str, int] = MappingProxyType({})
    failure: str = ""


def _run_rack(rack: RackConfig, board: str, seconds: float, share: bool, awake: bool) -> RackRun:
    """Run a rack once, and return the lateness and cycle counts of a board, and any failure."""
    with (
        TemporaryDirectory(prefix="rack-bench-") as folder,
        keep_cores_awake() if awake else nullcontext(),
    ):
        result, recording = record_rack(rack, seconds, Path(folder), share)
        late_us = compute_lateness_us(recording, board)
        return RackRun(late_us, result.tasks[board], result.outcome.failure)


def _run_cyclictest(grid: WakeGrid) -> RackRun:
    """Run `cyclictest` once, and return its lateness as a run without cycle counts."""
    return RackRun(run_cyclictest(grid))


def compare_idle_cores(samples: Sequence[Sample], who: str) -> str:
    """Recommend a value of `clock.idle_cores` for this machine, with the figures for both values.

    A wake-up is lost if it is late by a period or more. The setting with fewer lost wake-ups wins
    if the counts differ by more than two standard deviations. Otherwise the setting with the
    smaller worst lateness wins, because a host that takes the core away affects the worst lateness
    first.

    Args:
        samples: Lateness of all contestants.
        who: Name of the rack's fastest board.

    Returns:
        The recommendation. Empty unless both settings were measured.
    """
    results = []
    for setting, name in (("sleep", who), ("awake", who + AWAKE_SUFFIX)):
        runs = [sample for sample in samples if sample.who == name]
        if not runs:
            return ""
        lost = sum(us >= 1e6 / float(each.case.split()[0]) for each in runs for us in each.values)
        worst_us = max(each.worst for each in runs)
        figures = (
            f'"{setting}", {lost} wake-ups late by a period, worst {format_value(worst_us)} us'
        )
        results.append((lost, worst_us, figures))
    total = sum(lost for lost, _, _ in results)
    is_apart = abs(results[0][0] - results[1][0]) > 2.0 * math.sqrt(total)
    best, other = sorted(results, key=lambda result: result[0] if is_apart else result[1])
    return f"clock.idle_cores that suits this machine: {best[2]}; with {other[2]}"
