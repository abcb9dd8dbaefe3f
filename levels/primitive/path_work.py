"""A PATH segment under way: sets out when planned and clear, holds when told or guarded, is done when settled."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.messages import Error
from rack.levels.primitive.fault import Fault
from rack.levels.primitive.guard import Guard
from rack.levels.primitive.params import PrimitiveParams
from rack.levels.primitive.path import BlendedPath
from rack.levels.primitive.path_motion import PathMotion
from rack.levels.primitive.segment import Segment
from rack.levels.primitive.speed import BrakingLimits, JointLimits, braking_limits
from rack.levels.primitive.tracking import Quiet
from rack.levels.primitive.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class WorkRules:
    """What every piece of work needs of its level; `period_s` is the cycle, in s."""

    joints: tuple[str, ...]
    limits: JointLimits
    params: PrimitiveParams
    period_s: float

    @property
    def braking(self) -> BrakingLimits:
        """Limits of a hold."""
        return braking_limits(self.limits, self.params.braking)

    def cycles(self, time_s: float) -> int:
        """Return the cycles that fill `time_s`."""
        return max(1, round(time_s / self.period_s))

    def quiet(self) -> Quiet:
        """Return a fresh count of settled cycles."""
        return Quiet(self.params.settled_cycles, self.cycles(self.params.settling))

    @property
    def latency_s(self) -> float:
        """Time from the end of a trajectory until its segment is done, in s: set point, status, settled cycles."""
        return (self.params.settled_cycles + 3) * self.period_s


class PathWork:
    """One PATH segment under way. `fault` is set when it cannot be done, `blocked` while something is in the way."""

    def __init__(self, segment: Segment, path: BlendedPath, guard: Guard, rules: WorkRules) -> None:
        self.segment = segment
        self.motion = PathMotion(path, rules.braking, rules.params.bridging)
        self.fault: Fault | None = None
        self.blocked = False
        self.astray = False
        self.obstacle = ""  # what was in the way when the motion was blocked last
        self._guard = guard
        self._rules = rules
        self._quiet = rules.quiet()
        self._clear_cycles = 0
        self._fresh = True

    def begin_at(self, position: Array) -> None:
        """Be ready to set out from `position` (joints,), rad, where the path must begin."""
        permitted = self._rules.params.astray
        distance = self.motion.rest_at(position)
        if distance > permitted:
            begins = f"segment {self.segment.id} begins {distance:.4f} rad from where the arm rests"
            self.fault = Fault(Error.LIMIT, f"{begins}; at most {permitted} is valid")

    def begin_near(self, position: Array, progress: float) -> None:
        """Be ready to go on from `position` (joints,), rad; blocked when that is off the path.

        `progress`, 0 to 1, is about how much of the path is behind.
        """
        self._fresh = False
        self._clear_cycles = 0
        self._quiet = self._rules.quiet()
        away = self.motion.rest_near(position, progress)
        self.astray = self.blocked = away > self._rules.params.astray
        self.obstacle = f"the arm is {away:.3f} rad off its path"

    def step(self, hold: bool, trajectory: Trajectory | None, world: Message, now_s: float, duration_s: float) -> None:
        """Go on by one cycle of `duration_s`; `trajectory` is the plan from where the motion rests, if there is one.

        `now_s` is the simulated time of the set point commanded last.
        """
        motion = self.motion
        if motion.trajectory is not None and not motion.stopping:
            clear = self._guard.is_clear(motion.path, motion.trajectory, motion.time_s, world)
            self._block(not clear)
            if hold or self.blocked:
                motion.hold()
        elif motion.resting and trajectory is not None and not motion.finished and not self.astray:
            clear = self._guard.is_clear(motion.path, trajectory, 0.0, world)
            self._set_out(hold, clear, trajectory, now_s)
        motion.advance(duration_s)

    def done(self, status: Message) -> bool:
        """Say whether set point and arm rest at the end of the path."""
        if not self.motion.finished:
            return False
        away = np.abs(status.position - self.motion.set_point.position)
        settled = self._quiet.settled(bool((away < self._rules.params.settled).all()))
        if self._quiet.overdue and not settled:
            joint, permitted = int(away.argmax()), self._rules.params.settled
            name = self._rules.joints[joint]
            reason = f"joint '{name}' rests {away[joint]:.4f} rad from its goal; at most {permitted} is valid"
            self.fault = Fault(Error.FOLLOWING, reason)
        return settled

    @property
    def begin_wanted(self) -> float | None:
        """Where on the path a trajectory is to begin, in rad; None when the motion needs none."""
        motion = self.motion
        return motion.s if motion.resting and not motion.finished and not self.astray else None

    @property
    def progress(self) -> float:
        """Part of the path that is behind, 0 to 1."""
        length = self.motion.path.length
        return self.motion.s / length if length > 0.0 else 1.0

    def ends_s(self, now_s: float) -> float:
        """Return the simulated time at which the segment should be done; 0 when that is not known."""
        if self.motion.stopping or (self.motion.resting and not self.motion.finished):
            return 0.0
        return now_s + self.motion.remaining_s + self._rules.latency_s

    def _set_out(self, hold: bool, clear: bool, trajectory: Trajectory, now_s: float) -> None:
        self._clear_cycles = self._clear_cycles + 1 if clear else 0
        wanted = self._rules.cycles(self._rules.params.clear) if self.blocked else 1
        self._block(self._clear_cycles < wanted)
        if hold or self.blocked:
            return
        timed = self._timed(trajectory, now_s)
        if timed is not None:
            self.motion.follow(timed)
            self._fresh = False
            self._clear_cycles = 0

    def _block(self, blocked: bool) -> None:
        if blocked and not self.blocked:
            self.obstacle = self._guard.obstacle
        self.blocked = blocked

    def _timed(self, trajectory: Trajectory, now_s: float) -> Trajectory | None:
        """Stretch the trajectory to end just in time; refuse one that is too late before anything has moved."""
        if not self.segment.by or not trajectory.duration:
            return trajectory
        available = self.segment.by - self._rules.latency_s - now_s
        if available < trajectory.duration and self._fresh:
            earliest = now_s + trajectory.duration + self._rules.latency_s
            self.fault = too_late(self.segment, earliest)
            return None
        return trajectory.stretched(max(1.0, available / trajectory.duration))


def too_late(segment: Segment, earliest: float) -> Fault:
    """Return the fault of a segment that could be done at `earliest`, in s, but is wanted before."""
    earliest = ceil(earliest * 1e3) / 1e3  # what is read there must be met when it is asked for
    reason = f"segment {segment.id} is wanted by {segment.by:.3f} s; the earliest is {earliest:.3f} s"
    return Fault(Error.TOO_LATE, reason, earliest)
