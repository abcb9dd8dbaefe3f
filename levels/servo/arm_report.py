"""Fills the messages in which a level reports on the arm that it drives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rack.backplane.message import Message, State
from rack.backplane.words import Demand
from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.messages import ArmState, DrivenArm, Error
from rack.levels.servo.sensor_monitor import SensorMonitor
from rack.levels.servo.stopping import Stopping

if TYPE_CHECKING:
    from rack.levels.arm import Arm


class SetPointStatus(NamedTuple):
    """Report of a level on its set points in one cycle."""

    command: int  # id of the newest command
    holding: bool  # no set point is fresh
    stopped: bool  # the arm does not follow its set points
    cut: int  # cycles so far in which the level itself cut a set point or a torque
    reason: str  # why the arm does not follow its set points, or empty
    has_work: bool  # the level has work that `reason` keeps it from
    note: str = ""  # shown as the reason while there is no more important one


@dataclass
class ArmReport:
    """Fills the status of a level that drives an arm, and the estimate in its state.

    Numbers change in every cycle and are written through views of the messages. The other fields
    are written only in cycles in which one of them has changed.
    """

    status: DrivenArm
    state: ArmState
    arm: Arm
    sensors: SensorMonitor
    stopping: Stopping
    slow: str  # reason shown while the speed of the arm is reduced

    def __post_init__(self) -> None:
        self._joints = view_numbers(self.status, "position", "target_velocity").reshape(5, -1)
        self._gripper = view_numbers(self.status, "opening", "grip_force")
        self._estimate = view_numbers(self.state, "position", "doubt").reshape(3, -1)
        self._written: tuple[object, ...] = ()  # fields in the last status that seldom change

    def write_cycle(
        self,
        sensed: Sensed,
        wanted: Array,
        followed: SetPointStatus,
        demand: Demand,
        speed_scale: float,
    ) -> None:
        """Write the numbers of this cycle, and the other fields if one of them has changed.

        Args:
            sensed: Sample of this cycle, which gives the opening of the gripper.
            wanted: Motion wanted for the joints. Its first rows are positions, rad, and velocities,
                rad/s.
            followed: How the level follows its set points.
            demand: Stop that the rack requires of the arm, if any.
            speed_scale: Permitted fraction of full speed, up to 1.
        """
        joints = self._joints
        self._estimate[:] = self.sensors.estimate
        joints[:2] = self.sensors.state
        joints[2] = self.arm.torque
        joints[3:] = wanted[:2]
        self._gripper[:] = sensed.opening, sensed.opening_velocity, self.arm.grip_force
        arm = self.arm
        stopping = self.stopping
        fields = (
            followed,
            arm.braked,
            demand,
            arm.clipped,
            arm.touches,
            arm.violations,
            arm.pushed,
            speed_scale,
            stopping.error,
            arm.fault,
        )
        if fields == self._written:
            return
        self._written = fields
        status = self.status
        slowed = speed_scale < 1.0
        status.echo = followed.command
        status.holding = followed.holding
        status.stopped = followed.stopped
        status.braked = arm.braked
        status.demand = demand
        status.clipped = arm.clipped + followed.cut
        status.touches = arm.touches
        status.violations = arm.violations
        status.pushed = arm.pushed
        status.slowed = slowed
        status.reason = followed.reason
        if stopping.is_disabled:
            status.state = State.HOLDING
            status.error = stopping.cause
        elif arm.fault:
            status.state = State.ERROR
            status.error = Error.SIMULATION
            status.reason = arm.fault
        elif stopping.error:
            status.state = State.ERROR
            status.error = stopping.error
        else:
            resting = State.IDLE if followed.holding else State.EXECUTING
            is_kept = followed.reason and followed.has_work
            status.state = State.HOLDING if is_kept else resting
            touched = Error.TOUCHED if arm.touches else Error.NONE
            status.error = Error.LIMIT if arm.violations else touched
            broken = arm.first_violation if arm.violations else arm.first_touch
            slow = self.slow if slowed else ""
            status.reason = followed.reason or broken or slow or followed.note


def view_numbers(message: Message, first: str, last: str) -> Array:
    """Return a view of adjacent numeric fields of a message as one array.

    Args:
        message: Message that contains the fields.
        first: Name of the first field.
        last: Name of the last field.
    """
    fields = message.record.dtype.fields
    assert fields is not None
    begin = fields[first][1]
    end = fields[last][1] + fields[last][0].itemsize
    return np.frombuffer(message.raw[begin:end])
