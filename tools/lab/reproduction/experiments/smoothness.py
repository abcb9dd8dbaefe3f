"""Motion of an arm whose servo level begins its cycles late, ends them late, or has fewer of them.

All runs are in lockstep and differ in one fault or one rate only, so their motions differ by
nothing else. The arm has encoders like those of real arms: with exact encoders the servo level
would stop at a hundredth of this jitter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import log1p

import numpy as np

from rack.tools.console.answer import Failure
from rack.tools.console.tables import format_decimal, format_table
from rack.tools.lab.reproduction.experiments.experiment import ChartedRecord, Experiment, Workshop
from rack.tools.recording.recording import Recording
from rack.tools.report.arm_outcome import DRIVING, find_signals

NAME = "nasrem"
RESOLUTION_RAD = 1e-4
SETTINGS = (
    "clock.mode=lockstep",
    f"robot.sensors={{ resolution = {RESOLUTION_RAD}, noise = {RESOLUTION_RAD / 2} }}",
)
FIRST_TICK = 2000
"""Tick at which each fault begins, shortly before the arm moves for the first time."""
SECONDS = 7.5
RUN_S = 4.5
JITTER_TICKS = (0.05, 0.1, 0.4)
"""Largest lateness of the clock's ticks. The smallest is 0."""
OVERRUN_CYCLES = (0.95, 2.0, 4.0)
"""Largest computing time of the servo level's cycles. The smallest is 0."""
RATES_HZ = (200, 100, 50)
"""Rates of the servo level, instead of 400 Hz."""
JERK_STEP_TICKS = 8
"""Time over which velocities are compared for the jerk: a set point of the level above."""
BAR_WIDTH = 30


@dataclass(frozen=True)
class MotionPoint:
    """Motion in one run, from tick `FIRST_TICK` on.

    Attributes:
        value: Jitter in ticks, overrun in cycles, or rate in Hz.
        deviation_ms: Standard deviation of the time between the starts of two cycles, ms.
        error_mrad: Largest distance of a joint from its set point, mrad.
        jerk_rad_s3: Root mean square of the arm's jerk, rad/s3.
        brakings: Number of times that the brakes have engaged.
        moved_rad: Length of the arm's path in joint space, rad.
    """

    value: float
    deviation_ms: float
    error_mrad: float
    jerk_rad_s3: float
    brakings: int
    moved_rad: float


@dataclass(frozen=True)
class SmoothnessRun(ChartedRecord):
    """Motions under growing jitter, under growing overruns and at falling rates.

    Attributes:
        undisturbed: Motion without faults.
        jitter: Motions with late ticks of the clock.
        overrun: Motions with a servo level that computes longer.
        rate: Motions at lower rates of the servo level.
    """

    undisturbed: MotionPoint
    jitter: tuple[MotionPoint, ...]
    overrun: tuple[MotionPoint, ...]
    rate: tuple[MotionPoint, ...]


def _measure_smoothness(workshop: Workshop) -> SmoothnessRun:
    """Run the rack without faults, then once for each point of the three sweeps."""
    undisturbed = _measure_point(workshop, 0.0)
    jitter = measure_jitter(workshop)
    overrun = tuple(
        _measure_point(workshop, by, _build_fault("overrun", "servo", by=by, random=1))
        for by in OVERRUN_CYCLES
    )
    rate = tuple(
        _measure_point(workshop, rate_hz, f"board.servo.rate_hz={rate_hz}") for rate_hz in RATES_HZ
    )
    points = [
        ("undisturbed", "", undisturbed),
        *(("jitter", f"{point.value:g} ticks", point) for point in jitter),
        *(("overrun", f"{point.value:g} cycles", point) for point in overrun),
        *(("rate", f"{point.value:g} Hz", point) for point in rate),
    ]
    chart = "\n".join(_format_chart(points))
    return SmoothnessRun(undisturbed, jitter, overrun, rate, chart=chart)


def measure_jitter(workshop: Workshop) -> tuple[MotionPoint, ...]:
    """Run the rack with each jitter of the clock."""
    return tuple(
        _measure_point(workshop, late, _build_fault("clock-jitter", "clock", late=late, least=0))
        for late in JITTER_TICKS
    )


SMOOTHNESS = Experiment(
    "smoothness",
    "the motion of an arm with jitter, overruns and lower rates",
    (1 + len(JITTER_TICKS) + len(OVERRUN_CYCLES) + len(RATES_HZ)) * RUN_S,
    SmoothnessRun,
    _measure_smoothness,
    cores=0,
)


def _build_fault(kind: str, board: str, **parameters: float) -> str:
    """Return the setting that injects a fault from `FIRST_TICK` to the end of the run."""
    values = "".join(f", {name} = {value}" for name, value in parameters.items())
    return f'fault=[{{ kind = "{kind}", board = "{board}", tick = {FIRST_TICK}{values} }}]'


def _measure_point(workshop: Workshop, value: float, *settings: str) -> MotionPoint:
    """Run the rack with additional settings, and measure the motion of its arm."""
    config = workshop.load_config(NAME, (*SETTINGS, *settings))
    return measure_motion(workshop.run("smoothness", config, SECONDS).recording, value)


def measure_motion(run: Recording, value: float) -> MotionPoint:
    """Measure the motion of the arm of a run in lockstep from `FIRST_TICK` on.

    Args:
        run: The run.
        value: Value of the point in its sweep.

    Raises:
        Failure: The arm has no status, or the run ended before `FIRST_TICK`.
    """
    writer = next((m.writer for m in run.layout.mailboxes if m.message in DRIVING), "")
    status = find_signals(run, *DRIVING)
    if status is None or len(ticks := status("tick")) == 0 or ticks[-1] <= FIRST_TICK:
        raise Failure(f"{NAME}: no status of an arm after tick {FIRST_TICK}")
    late = ticks >= FIRST_TICK
    position = status("position")[late]
    error = np.abs(position - status("target")[late])
    # Velocities at common ticks, whatever the rate and whichever cycles were skipped.
    grid = np.arange(FIRST_TICK, ticks[-1] + 1, JERK_STEP_TICKS)
    velocity = status("velocity")[np.searchsorted(ticks, grid, side="right") - 1]
    step_s = JERK_STEP_TICKS * run.layout.clock_ns * 1e-9
    jerk = np.diff(velocity, 2, axis=0) / step_s**2
    rows = run.read_trace(writer)
    starts_ns = rows["tick"] * run.layout.clock_ns + rows["start_ns"] - rows["release_ns"]
    between_ns = np.diff(starts_ns[rows["tick"] >= FIRST_TICK])
    return MotionPoint(
        value,
        float(between_ns.std()) * 1e-6,
        float(error.max()) * 1e3,
        float(np.sqrt((jerk**2).sum(axis=1).mean())),
        int(np.count_nonzero(np.diff(status("braked")[late].astype(int)) > 0)),
        float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum()),
    )


def _format_chart(points: Sequence[tuple[str, str, MotionPoint]]) -> Iterator[str]:
    """Yield the lines of a table of all points, with a bar for the tracking error.

    Args:
        points: Name of the sweep, value as text, and motion of each point.
    """
    full = log1p(max(point.error_mrad for _, _, point in points))
    rows = [
        [
            sweep,
            value,
            format_decimal(point.deviation_ms, 3),
            format_decimal(point.error_mrad, 2),
            format_decimal(point.jerk_rad_s3, 0),
            str(point.brakings),
            "█" * max(1, round(BAR_WIDTH * log1p(point.error_mrad) / full)) if full else "",
        ]
        for sweep, value, point in points
    ]
    head = ["sweep", "value", "deviation ms", "error mrad", "jerk rad/s3", "brakings", "error, log"]
    return format_table(head, rows)
