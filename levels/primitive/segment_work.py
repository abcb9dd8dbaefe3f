"""Execution of segments.

Motion along a path starts when the path is planned and clear. It holds on command, and when the
guard finds an obstacle. The segment is done when the arm has settled. A gripper segment is done
when the gripper is at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field

from rack.levels.algebra import Array
from rack.levels.messages import DrivenArm, Error, WorldState
from rack.levels.motion.path import BlendedPath
from rack.levels.motion.trajectory import Trajectory
from rack.levels.primitive.motion_segment import MotionSegment, SegmentFault
from rack.levels.primitive.path_guard import PathGuard
from rack.levels.primitive.path_motion import PathMotion
from rack.levels.primitive.tracking import HANDOVER_CYCLES
from rack.levels.robot.limits import Limits
from rack.levels.tables import GripperConfig, Positive, Table

ANSWER_CYCLES = 3
"""Cycles from the end of a trajectory until its segment is reported done, in addition to settling.

During these the last set point becomes due, the status of the servo shows it, and the status of
this level becomes visible."""


class PrimitiveParams(Table):
    """`[board.<name>.params]`: bounds of following, settling and guarding."""

    following: Positive = 0.05
    """largest distance of a joint from its set point during motion [rad]"""
    straying: Positive = 0.1
    """time that a joint may be farther than that before it is an error [s]"""
    settled: Positive = 0.003
    """largest distance of a settled joint from its goal [rad]"""
    settled_opening: Positive | None = None
    """largest speed of a settled gripper [m/s or rad/s]; default: a twentieth of its travel in a
    second"""
    settled_cycles: int = Field(3, ge=1, le=100)
    """consecutive cycles within these bounds after which an arm counts as settled"""
    settling: Positive = 3.0
    """longest time that arm or gripper may take to settle [s]"""
    astray: Positive = 0.02
    """largest distance of a joint from the path when motion begins [rad]"""
    bridging: Positive = 0.5
    """time in which such a distance is removed [s]"""
    silent: Positive = 10.0
    """time without status from below, restarts included, after which it is an error [s]"""
    blind: Positive = 0.2
    """time without a new scene in the world model after which motion holds [s]"""
    braking: float = Field(1.5, ge=1.0, le=3.0)
    """multiple of the planned acceleration and jerk limits that a hold may use"""
    lookahead: Positive = 2.0
    """time ahead of the arm that the guard checks in every cycle [s]"""
    clear: Positive = 0.5
    """time for which the path must be clear before held motion continues [s]"""


@dataclass(frozen=True)
class WorkRules:
    """Limits and parameters for the execution of segments."""

    joints: tuple[str, ...]
    limits: Limits
    params: PrimitiveParams
    period_s: float  # the level's cycle

    def count_cycles(self, time_s: float) -> int:
        """Convert a time to a number of cycles, at least 1."""
        return max(1, round(time_s / self.period_s))

    @property
    def latency_s(self) -> float:
        """Time from the end of a trajectory until its segment is reported done, in s."""
        return (self.params.settled_cycles + ANSWER_CYCLES) * self.period_s


class SettlingCounter:
    """Decides whether the arm or the gripper has settled, or takes too long to settle.

    It has settled after `settled_cycles` consecutive cycles in which its error or speed is small.
    """

    def __init__(self, rules: WorkRules) -> None:
        self._wanted_cycles = rules.params.settled_cycles
        self._most_cycles = rules.count_cycles(rules.params.settling)
        self._quiet = 0
        self._cycles = 0

    def count_cycle(self, quiet: bool) -> bool:
        """Count one cycle.

        Args:
            quiet: True if the error or speed in this cycle is small.

        Returns:
            True if the arm or the gripper has settled.
        """
        self._cycles += 1
        self._quiet = self._quiet + 1 if quiet else 0
        return self._quiet >= self._wanted_cycles

    @property
    def is_overdue(self) -> bool:
        """True if settling has taken longer than permitted."""
        return self._cycles > self._most_cycles


class PathWork(PathMotion):
    """Execution of one PATH segment: a guarded motion along its path.

    Attributes:
        segment: The segment.
        fault: Why the segment cannot be done, or None.
        blocked: True if an obstacle is on the path, or the arm is too far from the path.
        astray: True if the arm is too far from the path.
        obstacle: Description of what blocked the motion last.
        unplanned_cycles: Number of consecutive cycles in which the motion has waited for a
            trajectory.
    """

    def __init__(
        self, segment: MotionSegment, path: BlendedPath, guard: PathGuard, rules: WorkRules
    ) -> None:
        planned = rules.limits
        factor = rules.params.braking
        braking = replace(
            planned, acceleration=factor * planned.acceleration, jerk=factor * planned.jerk
        )
        super().__init__(path, braking, rules.params.bridging)
        self.segment = segment
        self.fault: SegmentFault | None = None
        self.blocked = False
        self.astray = False
        self.obstacle = ""
        self.unplanned_cycles = 0
        self._guard = guard
        self._rules = rules
        self._quiet = SettlingCounter(rules)
        self._clear_cycles = 0
        self._fresh = True

    def begin_at(self, position: Array) -> None:
        """Prepare to start at the beginning of the path. Set `fault` if the arm is not near it.

        Args:
            position: Position of the arm, (joints,), rad.
        """
        permitted = self._rules.params.astray
        distance = self.reset_to(0.0, position)
        if distance > permitted:
            self.fault = SegmentFault(
                Error.LIMIT,
                f"segment {self.segment.id} begins {distance:.4f} rad from where the arm rests;"
                f" valid: at most {permitted} rad",
            )

    def begin_near(self, position: Array, progress: float) -> None:
        """Prepare to continue from the point of the path that is nearest to the arm.

        The segment is blocked if the arm is too far from the path.

        Args:
            position: Position of the arm, (joints,), rad.
            progress: Approximate fraction of the path that is done, 0 to 1.
        """
        self._fresh = False
        self._clear_cycles = 0
        self._quiet = SettlingCounter(self._rules)
        distance = self.reset_to_nearest(position, progress)
        self.astray = self.blocked = distance > self._rules.params.astray
        self.obstacle = f"the arm is {distance:.3f} rad off its path"

    def step(
        self,
        hold: bool,
        plan: Trajectory | None,
        world: WorldState,
        due_s: float,
        passed_s: float,
        speed_scale: float,
    ) -> None:
        """Run one cycle: check the path, start or hold the motion, and advance it.

        Args:
            hold: True to hold the motion.
            plan: Trajectory that begins where the motion rests, or None.
            world: Newest world model.
            due_s: Simulated time of the set point commanded last.
            passed_s: Time since the cycle before.
            speed_scale: Part of full speed for a trajectory that begins.
        """
        waits = self.wanted_begin is not None
        if self.trajectory is not None and not self.stopping:
            self._set_blocked(
                not self._guard.is_clear(self.path, self.trajectory, self.time_s, world)
            )
            if hold or self.blocked:
                self.begin_hold()
        elif waits and plan is not None:
            if speed_scale < 1.0:
                plan = plan.stretch_by(1.0 / speed_scale)
            self._start(plan, hold, world, due_s)
        self.unplanned_cycles = self.unplanned_cycles + 1 if waits and plan is None else 0
        self.advance_by(passed_s)

    def check_done(self, status: DrivenArm) -> bool:
        """Return True if set point and arm are at rest at the end of the path.

        Call this once for each new status. It sets `fault` if the arm does not settle in time.
        """
        if not self.is_finished:
            return False
        distances = np.abs(status.position - self.set_point.position)
        settled = self._quiet.count_cycle(bool((distances < self._rules.params.settled).all()))
        if self._quiet.is_overdue and not settled:
            joint = int(distances.argmax())
            self.fault = SegmentFault(
                Error.FOLLOWING,
                f"joint '{self._rules.joints[joint]}' rests {distances[joint]:.4f} rad from its"
                f" goal; valid: at most {self._rules.params.settled} rad",
            )
        return settled

    @property
    def wanted_begin(self) -> float | None:
        """Path parameter in rad at which a trajectory must begin. None if the motion needs none."""
        return self.s if self.is_resting and not self.is_finished and not self.astray else None

    @property
    def progress(self) -> float:
        """Fraction of the path that is done, 0 to 1."""
        length = self.path.length
        return self.s / length if length > 0.0 else 1.0

    def compute_end_s(self, due_s: float) -> float:
        """Return the simulated time at which the segment will be done, or 0 if it is not known.

        Args:
            due_s: Simulated time at which the set point commanded last is due.
        """
        if self.stopping or (self.is_resting and not self.is_finished):
            return 0.0
        remaining_s = 0.0 if self.trajectory is None else self.trajectory.duration - self.time_s
        return due_s + remaining_s + self._rules.latency_s

    def _start(self, plan: Trajectory, hold: bool, world: WorldState, due_s: float) -> None:
        """Start the trajectory, unless motion must hold or the path has not been clear long enough.

        It is stretched to the deadline of the segment. See `step` for the arguments.
        """
        clear = self._guard.is_clear(self.path, plan, 0.0, world)
        self._clear_cycles = self._clear_cycles + 1 if clear else 0
        wanted = self._rules.count_cycles(self._rules.params.clear) if self.blocked else 1
        self._set_blocked(self._clear_cycles < wanted)
        if hold or self.blocked:
            return
        timed = self._stretch_to_deadline(plan, due_s)
        if timed is not None:
            self.follow_trajectory(timed)
            self._fresh = False
            self._clear_cycles = 0

    def _set_blocked(self, blocked: bool) -> None:
        """Set `blocked`. When the path becomes blocked, record the obstacle."""
        if blocked and not self.blocked:
            self.obstacle = self._guard.obstacle
        self.blocked = blocked

    def _stretch_to_deadline(self, trajectory: Trajectory, due_s: float) -> Trajectory | None:
        """Stretch a trajectory so that the segment is done just at its deadline, if it has one.

        Args:
            trajectory: Trajectory of the path.
            due_s: Simulated time of its start.

        Returns:
            The stretched trajectory. If a path that was not started before would end too late,
            `fault` is set and the result is None.
        """
        if not self.segment.by or not trajectory.duration:
            return trajectory
        available = self.segment.by - self._rules.latency_s - due_s
        if available < trajectory.duration and self._fresh:
            self.fault = self.segment.build_lateness_fault(
                due_s + trajectory.duration + self._rules.latency_s
            )
            return None
        return trajectory.stretch_by(max(1.0, available / trajectory.duration))


class GripperWork:
    """Execution of one GRIPPER segment.

    The gripper moves as far as its force permits, and the segment is done when it is at rest.
    """

    def __init__(self, segment: MotionSegment, gripper: GripperConfig, rules: WorkRules) -> None:
        self.segment = segment
        self._gripper = gripper
        closes = abs(segment.opening - gripper.closed) < abs(segment.opening - gripper.open)
        # Row of the object in the gripper after the segment, or -1 for none.
        self.held_after = segment.object if closes else -1
        self.fault: SegmentFault | None = None  # why the segment cannot be done
        self._rules = rules
        self.restart_wait()

    def restart_wait(self) -> None:
        """Start, or restart, the time limit within which the gripper must come to rest.

        Called at the start of the segment, and again when the servo gets back into step.
        """
        self._cycles = 0
        self._quiet = SettlingCounter(self._rules)

    def check_done(self, status: DrivenArm) -> bool:
        """Return True if the gripper is at rest.

        Call this once for each new status. It sets `fault` if the gripper takes too long.
        """
        self._cycles += 1
        # The gripper is also at rest before the command reaches it.
        if self._cycles <= HANDOVER_CYCLES:
            return False
        speed = abs(status.opening_velocity)
        permitted = self._rules.params.settled_opening or self._gripper.rest_threshold
        settled = self._quiet.count_cycle(speed < permitted)
        if self._quiet.is_overdue and not settled:
            self.fault = SegmentFault(
                Error.FOLLOWING,
                f"gripper still moves {speed / self._gripper.travel:.1%} of its way in a second; it"
                f" must come below {permitted / self._gripper.travel:.1%}",
            )
        return settled
