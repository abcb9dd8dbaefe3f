"""The planner of the primitive level: times the next path, in the background, while the executor moves."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message
from rack.levels.level import Input, LevelContext, Planner, Ports
from rack.levels.messages import MOVE_COMMAND, PRIMITIVE_STATUS, TRAJECTORY, Error
from rack.levels.primitive.fault import Fault
from rack.levels.primitive.params import PrimitiveParams
from rack.levels.primitive.path import BlendedPath
from rack.levels.primitive.path_work import WorkRules, too_late
from rack.levels.primitive.segment import Segment, read_segment, window
from rack.levels.primitive.trajectory import Trajectory, make_trajectory
from rack.levels.robot.cell import build_cell
from rack.levels.tables import read_params


class PrimitivePlanner(Planner):
    """Makes the trajectory that the executor's status wants: of the next segment, or from where a path was held."""

    inputs = {
        "command": Input(MOVE_COMMAND, "above.command"),
        "status": Input(PRIMITIVE_STATUS, "own.status"),
    }
    output = TRAJECTORY
    params = PrimitiveParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        limits = build_cell(context.robot, context.scene, context.clock_ns).limits
        self._positions = limits.position
        params = read_params(PrimitiveParams, context.params)
        self._rules = WorkRules(context.robot.joints, limits, params, context.period_s)
        self._made = (0, 0.0)
        self._answered_at = 0

    def wanted(self, read: Ports, tick: int) -> bool:
        """Say whether the executor wants a trajectory that it has not been given."""
        status = read.status.value
        if status.wants not in window(read.command.value):
            return False
        # A plan needs a cycle to show in the status; wanted still later, it was lost with the board, and is made anew.
        return (status.wants, status.begin) != self._made or tick > self._answered_at

    def plan(self, read: Ports, write: Message, tick: int) -> None:
        """Time the wanted segment from where it is to begin, or say why not."""
        status, context = read.status.value, self.context
        serial, begin = status.wants, status.begin
        published = tick + context.within_cycles * context.every
        self._made, self._answered_at = (serial, begin), published + context.every
        write.segment, write.begin = serial, begin
        write.duration, write.earliest, write.count = 0.0, 0.0, 0
        fault: Fault | None = None
        try:
            segment = read_segment(read.command.value, serial)
            trajectory = make_trajectory(self._path(segment), self._rules.limits, begin)
            start_s = max((published + context.every) * context.tick_s, status.ends)
            fault = self._write(write, segment, trajectory, start_s)
        except (ValueError, ArithmeticError) as error:
            fault = Fault(Error.LIMIT, f"segment {serial}: {error}")
        write.error, write.reason, write.earliest = fault or (0, "", write.earliest)

    def _path(self, segment: Segment) -> BlendedPath:
        """Return the segment's path. Raises `ValueError` for one that cannot be, or leaves a joint's range."""
        path = segment.path()
        low, high = self._positions.T
        outside = np.argwhere((path.waypoints < low) | (path.waypoints > high))
        if len(outside):
            k, j = outside[0]
            place = f"waypoint {k}, joint '{self.context.robot.joints[j]}' at {path.waypoints[k, j]:.4f} rad"
            raise ValueError(f"{place}; {low[j]:.4f} to {high[j]:.4f} is valid")
        return path

    def _write(self, write: Message, segment: Segment, trajectory: Trajectory, start_s: float) -> Fault | None:
        sections = trajectory.sections
        write.duration, write.count = trajectory.duration, len(sections)
        write.sections[: len(sections)] = sections
        write.earliest = start_s + trajectory.duration + self._rules.latency_s
        fresh = trajectory.begin == 0.0
        return too_late(segment, write.earliest) if fresh and 0.0 < segment.by < write.earliest else None
