"""The planner of the primitive level: times the next path while the executor moves."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from rack.levels.level import Input, LevelContext, Output, Planner, Reading
from rack.levels.messages import Error, MoveCommand, PrimitiveStatus, TrajectoryPlan
from rack.levels.motion.path import BlendedPath
from rack.levels.motion.trajectory import Trajectory, make_trajectory
from rack.levels.primitive.motion_segment import (
    MotionSegment,
    SegmentFault,
    list_serials,
    read_segment,
)
from rack.levels.primitive.segment_work import PrimitiveParams, WorkRules
from rack.levels.robot.cell import build_level_cell


class PrimitivePlanner(Planner):
    """Computes the trajectory that the status of the executor requests.

    The trajectory covers the next path segment, or the rest of a path on which motion was held.
    """

    above = Input(MoveCommand, "above.command")
    status = Input(PrimitiveStatus, "own.status")
    output = Output(TrajectoryPlan)
    params = PrimitiveParams
    settings: PrimitiveParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        limits = build_level_cell(context).limits
        self._rules = WorkRules(context.robot.joints, limits, self.settings, context.period_s)
        self._last_plan = (0, 0.0)
        self._answered_at = 0

    def wanted(self, tick: int) -> bool:
        """Return True if the executor requests a trajectory that it has not received yet."""
        status = self.status.message
        if status.wants not in list_serials(self.above.message):
            return False
        # The status shows the effect of a plan one cycle later. If the plan is still wanted after
        # that, it was lost in a restart of the board.
        return (status.wants, status.begin) != self._last_plan or tick > self._answered_at

    def plan(self, tick: int) -> None:
        """Compute the trajectory of the requested segment, or write the reason for a refusal."""
        plan = self.output
        status = self.status.message
        context = self.context
        serial = status.wants
        begin = status.begin
        published = tick + context.within_cycles * context.every
        self._last_plan = (serial, begin)
        self._answered_at = published + context.every
        plan.segment = serial
        plan.begin = begin
        plan.duration = 0.0
        plan.count = 0
        fault: SegmentFault | None = None
        try:
            segment = read_segment(self.above.message, serial)
            trajectory = make_trajectory(self._build_path(segment), self._rules.limits, begin)
            start_s = max((published + context.every) * context.tick_s, status.ends)
            sections = trajectory.sections
            plan.duration = trajectory.duration
            plan.count = len(sections)
            plan.sections[: len(sections)] = sections
            plan.earliest = start_s + trajectory.duration + self._rules.latency_s
            if trajectory.begin == 0.0 and 0.0 < segment.by < plan.earliest:
                fault = segment.build_lateness_fault(plan.earliest)
        except (ValueError, ArithmeticError) as error:
            fault = SegmentFault(Error.LIMIT, f"segment {serial}: {error}")
        plan.error, plan.reason, plan.earliest = fault or (Error.NONE, "", plan.earliest)

    def _build_path(self, segment: MotionSegment) -> BlendedPath:
        """Build the path of a segment, and check that the arm can follow it.

        Raises:
            ValueError: The path is invalid or leaves the range of a joint.
        """
        path = segment.build_path()
        low, high = self._rules.limits.position.T
        outside = np.argwhere((path.waypoints < low) | (path.waypoints > high))
        if len(outside):
            k, j = outside[0]
            raise ValueError(
                f"waypoint {k}, joint '{self.context.robot.joints[j]}' at"
                f" {path.waypoints[k, j]:.4f} rad; valid: {low[j]:.4f} to {high[j]:.4f}"
            )
        return path


class Plans:
    """Stores the planner's answers: the newest trajectory or refusal of each open segment."""

    def __init__(self) -> None:
        self._plans: dict[int, Trajectory | SegmentFault] = {}

    def accept_plan(self, plan: Reading[TrajectoryPlan], window: Collection[int]) -> None:
        """Copy a new plan, and drop plans of segments that have left the window."""
        for serial in [s for s in self._plans if s not in window]:
            del self._plans[serial]
        message = plan.message
        serial = message.segment
        if not plan.is_new or serial not in window:
            return
        if message.error:
            self._plans[serial] = SegmentFault(
                Error(message.error), message.reason, message.earliest
            )
        else:
            self._plans[serial] = Trajectory(
                message.sections[: message.count].copy(), message.duration
            )

    def find_trajectory(self, serial: int, begin: float) -> Trajectory | None:
        """Return the trajectory of a segment that starts at path parameter `begin`, or None."""
        plan = self._plans.get(serial)
        return plan if isinstance(plan, Trajectory) and plan.begin == begin else None

    def find_refusal(self, serial: int) -> SegmentFault | None:
        """Return the fault with which the planner has refused a segment, or None."""
        plan = self._plans.get(serial)
        return plan if isinstance(plan, SegmentFault) else None
