"""A planner of one's own for the primitive level: trapezoids of speed in place of jerk-limited
trajectories."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rack.levels import Error, Input, LevelContext, Output, Planner
from rack.levels.messages import MoveCommand, PrimitiveStatus, TrajectoryPlan
from rack.levels.motion.path import BlendedPath
from rack.levels.primitive.segment import read_segment, window
from rack.levels.robot.cell import build_cell

SHARE = 0.7
"""Part of each joint's acceleration that a trapezoid uses: its corners ask for more than the model
can follow."""
SAMPLE_RAD = 0.02


class TrapezoidPlanner(Planner):
    """Accelerates, cruises and brakes along the path: between stops, with one speed and one
    acceleration."""

    above = Input(MoveCommand, "above.command")
    status = Input(PrimitiveStatus, "own.status")
    output = Output(TrajectoryPlan)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.limits = build_cell(context.robot, context.scene, context.clock_ns).limits
        self.made = (0, 0.0)  # segment, and path parameter at its begin, rad, of the newest plan

    def wanted(self, tick: int) -> bool:
        """Return whether the executor wants a trajectory that has not been made."""
        status = self.status.message
        return (
            status.wants in window(self.above.message) and (status.wants, status.begin) != self.made
        )

    def plan(self, tick: int) -> None:
        """Time the wanted segment, or give the reason why it cannot be timed."""
        status = self.status.message
        self.made = status.wants, status.begin
        self.output.clear()
        self.output.segment, self.output.begin = self.made
        try:
            path = read_segment(self.above.message, status.wants).path()
        except ValueError as error:
            self.output.error = Error.LIMIT
            self.output.reason = str(error)
            return
        sections = self.sections(path, status.begin)
        self.output.count = len(sections) - 1
        self.output.duration = sections[-1][0]
        self.output.sections[: self.output.count] = sections[:-1]
        published = tick + (self.context.within_cycles + 1) * self.context.every
        self.output.earliest = (
            max(published * self.context.tick_s, status.ends) + self.output.duration
        )

    def sections(
        self, path: BlendedPath, begin: float
    ) -> list[tuple[float, float, float, float, float]]:
        """Return start in s, then s, ds, dds and jerk of the path parameter per section; the last
        is the end."""
        found = []
        start_s = 0.0
        for first, last in pairwise(
            [begin, *(stop for stop in path.stops if begin < stop < path.length), path.length]
        ):
            speed, acceleration = self.limits_of(path, first, last)
            speed = min(speed, np.sqrt(acceleration * (last - first)))
            ramp_s = speed / acceleration
            ramp = 0.5 * speed**2 / acceleration
            cruise_s = (last - first - 2.0 * ramp) / speed
            found.append((start_s, first, 0.0, acceleration, 0.0))
            found.append((start_s + ramp_s, first + ramp, speed, 0.0, 0.0))
            found.append((start_s + ramp_s + cruise_s, last - ramp, speed, -acceleration, 0.0))
            start_s += 2.0 * ramp_s + cruise_s
        return [*found, (start_s, path.length, 0.0, 0.0, 0.0)]

    def limits_of(self, path: BlendedPath, first: float, last: float) -> tuple[float, float]:
        """Return the speed, rad/s, and acceleration, rad/s2, that every joint keeps between two
        path parameters."""
        speeds = []
        accelerations = []
        for s in np.linspace(first, last, 2 + int((last - first) / SAMPLE_RAD)):
            _, slope, curvature = (np.abs(values) for values in path.evaluate(s))
            speeds.append((self.limits.velocity / np.maximum(slope, 1e-9)).min())
            speeds.append(
                np.sqrt(0.5 * SHARE * self.limits.acceleration / np.maximum(curvature, 1e-9)).min()
            )
            accelerations.append(
                (0.5 * SHARE * self.limits.acceleration / np.maximum(slope, 1e-9)).min()
            )
        return float(min(speeds)), float(min(accelerations))
