"""A planner for the primitive level with trapezoidal instead of jerk-limited speed profiles."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from rack.levels import Error, Input, LevelContext, Output, Planner
from rack.levels.messages import MoveCommand, PrimitiveStatus, TrajectoryPlan
from rack.levels.motion.path import BlendedPath
from rack.levels.primitive.motion_segment import list_serials, read_segment
from rack.levels.robot.cell import build_cell

SHARE = 0.7
"""Fraction of each joint's acceleration that a trapezoid uses, because the arm cannot follow its
corners exactly."""
SAMPLE_RAD = 0.02


class TrapezoidPlanner(Planner):
    """Accelerates, cruises and brakes along the path.

    Between two stops the speed limit and the acceleration are constant.
    """

    above = Input(MoveCommand, "above.command")
    status = Input(PrimitiveStatus, "own.status")
    output = Output(TrajectoryPlan)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.limits = build_cell(context.robot, context.scene, context.clock_ns).limits
        self.made = (0, 0.0)  # newest plan: segment, and path parameter at its start, rad

    def wanted(self, tick: int) -> bool:
        """Return whether the executor needs a trajectory that has not been planned yet."""
        status = self.status.message
        return (
            status.wants in list_serials(self.above.message)
            and (status.wants, status.begin) != self.made
        )

    def plan(self, tick: int) -> None:
        """Plan the trajectory of a segment, or report why that is impossible."""
        status = self.status.message
        self.made = status.wants, status.begin
        self.output.clear()
        self.output.segment, self.output.begin = self.made
        try:
            path = read_segment(self.above.message, status.wants).build_path()
        except ValueError as error:
            self.output.error = Error.LIMIT
            self.output.reason = str(error)
            return
        sections = self.find_sections(path, status.begin)
        self.output.count = len(sections) - 1
        self.output.duration = sections[-1][0]
        self.output.sections[: self.output.count] = sections[:-1]
        published = tick + (self.context.within_cycles + 1) * self.context.every
        self.output.earliest = (
            max(published * self.context.tick_s, status.ends) + self.output.duration
        )

    def find_sections(
        self, path: BlendedPath, begin: float
    ) -> list[tuple[float, float, float, float, float]]:
        """Return the sections of the trajectory, followed by its end point.

        Args:
            path: Path of the segment.
            begin: Path parameter at the start in rad.

        Returns:
            For each section the start time in s, then position (rad), velocity, acceleration and
            jerk of the path parameter.
        """
        sections = []
        start_s = 0.0
        for first, last in pairwise(
            [begin, *(stop for stop in path.stops if begin < stop < path.length), path.length]
        ):
            speed, acceleration = self.find_limits(path, first, last)
            speed = min(speed, np.sqrt(acceleration * (last - first)))
            ramp_s = speed / acceleration
            ramp = 0.5 * speed**2 / acceleration
            cruise_s = (last - first - 2.0 * ramp) / speed
            sections.append((start_s, first, 0.0, acceleration, 0.0))
            sections.append((start_s + ramp_s, first + ramp, speed, 0.0, 0.0))
            sections.append((start_s + ramp_s + cruise_s, last - ramp, speed, -acceleration, 0.0))
            start_s += 2.0 * ramp_s + cruise_s
        return [*sections, (start_s, path.length, 0.0, 0.0, 0.0)]

    def find_limits(self, path: BlendedPath, first: float, last: float) -> tuple[float, float]:
        """Compute the speed and acceleration of the path parameter that all joints permit.

        Args:
            path: Path of the segment.
            first: Path parameter at the beginning of the section in rad.
            last: Path parameter at the end of the section in rad.

        Returns:
            Largest speed in rad/s and acceleration in rad/s2.
        """
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
