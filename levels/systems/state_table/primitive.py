"""The primitive level as a state table.

It moves the joints straight from rest to rest and operates the gripper. A motion is a smooth
stream of set points for the boards that servo the joints, two cycles ahead of the arm.
"""

from __future__ import annotations

import numpy as np

from rack.backplane.message import field, integer_field
from rack.levels.algebra import Array
from rack.levels.errors import RobotError
from rack.levels.level import OPERATOR, Input, Inputs, LevelContext, Output
from rack.levels.messages import joint_field
from rack.levels.robot.cell import build_level_cell
from rack.levels.robot.dynamics import Dynamics, Payload
from rack.levels.servo import curves
from rack.levels.servo.curves import Curve, Passage, Ramp
from rack.levels.systems.joint_boards.messages import ArmStatus, JointReference, JointStatus
from rack.levels.systems.state_table.level import (
    OPERATIONS,
    YES_NO,
    StateTableExecutor,
    TableCommand,
    TableStatus,
    build_vocabulary,
)
from rack.levels.tables import Positive, Table

LEAD_CYCLES = 2
"""Cycles from the release that computes a set point to the tick at which it is due.

The first cycle transports the set point, and during the second the boards below interpolate to it.
"""
HANDOVER_CYCLES = 4
"""Cycles after the first set point within which the boards below must follow."""
MIN_MOTION_RAD = 1e-9
"""A motion shorter than this is not started."""
MIN_SPEED = 0.01
GRIP_CYCLES = 6
"""Cycles after a command during which the gripper counts as moving, until its motion is sensed."""
MAX_GRIPPER_REST_M_S = 0.002
GRIPPER_TOLERANCE_M = 0.001
"""Distance from its open or closed position within which the gripper has reached it.

If it stops in between while closing, it holds something.
"""


class JointMove(TableCommand, version=1):
    """Command from the elemental move level of state tables to its primitive level."""

    joints: np.ndarray = joint_field("rad", "where a motion ends")
    speed: float = field(unit="1", doc="part of the joints' limits")
    object: int = integer_field("row of the object in the world model (-1: none)", "i2")
    aim: np.ndarray = field(
        unit="m", doc="where the object, or the place, was for this command", shape=3
    )
    yaw: float = field(unit="rad", doc="how it was turned about the vertical")


class JointMoveStatus(TableStatus, version=1):
    """Status of the primitive level of state tables."""

    position: np.ndarray = joint_field("rad", "joint positions commanded last")
    end: np.ndarray = joint_field("rad", "where the newest motion ends")
    moving: bool = field(doc="1: they still change")
    closed: bool = field(doc="1: the gripper is commanded to close")
    held: bool = field(doc="1: it holds something")
    object: int = integer_field("row of the object in the gripper (-1: none)", "i2")


class PrimitivePlanConfig(Table):
    """`[plan]` of the primitive level's table."""

    settled: Positive = 0.01
    """distance from its end position within which a joint has arrived [rad]"""


class PrimitiveTable(StateTableExecutor):
    """Executor that moves the joints along straight lines and operates the gripper."""

    above = Inputs(JointMove, "above.command", optional=True)
    statuses = Inputs(JointStatus, "below.status")
    arm = Input(ArmStatus, "arm.status")
    last_command = Input(JointReference, "own.command")
    last_status = Input(JointMoveStatus, "own.status")
    operator = OPERATOR
    command = Output(JointReference, rests_on=above)
    status = Output(JointMoveStatus, rests_on=statuses)
    commands = OPERATIONS
    preloads = (curves,)
    vocabulary = build_vocabulary(
        conditions={
            # Whether an operator or the level above holds this level, or the board above is lost.
            "hold": YES_NO,
            # `arrived` and `resting` both mean at rest: at the end of the newest motion, or
            # elsewhere. `away` means that the joints do not follow.
            "arm": ("arrived", "resting", "moving", "away"),
            # `empty` means that the gripper has closed on nothing.
            "gripper": ("moving", "open", "empty", "holds"),
        },
        # `move` moves the joints straight to the commanded positions.
        commands={"move": (), "open": (), "close": ()},
        actions={"begin": (), "halt": (), "open": (), "close": ()},
        plan=PrimitivePlanConfig,
    )

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_level_cell(context)
        if context.robot.gripper is None:
            raise RobotError("the level works a gripper, and [robot] has none")
        self._gripper = context.robot.gripper
        self._limits = cell.limits
        self._dynamics = Dynamics(cell)
        self._masses = cell.model.body_subtreemass[cell.bodies].copy()  # kg
        self._point = np.zeros((3, len(cell.home)))  # the newest set point: rad, rad/s, rad/s2
        self._point[0] = cell.home
        self._goal = cell.home.copy()  # (joints,), rad: goal of the newest command
        self._speed = 1.0  # its speed, a fraction of the limits
        self._end = cell.home.copy()  # (joints,), rad: where the newest motion ends
        self._curve: Curve | None = None  # None at rest
        self._curve_start_tick = 0  # tick at which the curve began
        self._following_cycles = (
            0  # cycles for which the boards below have followed, 0 if they do not
        )
        self._closed = False
        self._held = False
        self._held_row = -1
        self._target_row = -1  # row of the object that the newest command concerns
        self._due_tick = 0  # tick at which the set point of this cycle is due
        self._gripper_wait_cycles = 0  # cycles until the gripper's motion must be sensed

    def restore_state(self) -> None:
        """Restore the state of the gripper and the goal of the newest motion after a restart.

        The next motion starts at the position at which the boards below hold the arm.
        """
        super().restore_state()
        if self.last_status.has_message:
            last = self.last_status.message
            self._closed = last.closed
            self._held = last.held
            self._held_row = last.object
            self._point[0] = last.position
            self._end[:] = last.end
            self.command.copy_from(self.last_command.message)

    def evaluate_conditions(self, tick: int) -> dict[str, str]:
        """Return the values of the conditions `arm`, `gripper` and `hold`."""
        for reading in self.above.values():
            self._goal = reading.message.joints
            self._speed = reading.message.speed
            self._target_row = reading.message.object
        position = self._update_following()
        self._due_tick = tick + LEAD_CYCLES * self.context.every
        if self._curve is not None and self._passed_s >= self._curve.ends_s:
            self._point[0] = self._curve.table[curves.REST]
            self._point[1:] = 0.0
            self._curve = None
        is_away = np.abs(position - self._point[0]).max() > self.table.plan.settled
        self.resting = self._curve is None and not is_away
        is_at_end = np.abs(self._end - self._point[0]).max() <= self.table.plan.settled
        arm = "away"
        if self._following_cycles and not self.resting:
            arm = "moving"
        elif self._following_cycles:
            arm = "arrived" if is_at_end else "resting"
        return {
            "arm": arm,
            "gripper": self._classify_gripper(self.arm.message),
            "hold": YES_NO[self.is_held],
        }

    def _update_following(self) -> Array:
        """Count the cycles for which the boards below have followed the set points.

        Returns:
            Joint positions, (joints,), in rad.
        """
        readings = list(self.statuses.values())
        statuses = [reading.message for reading in readings]
        position: Array = statuses[0].position
        is_lost = any(reading.is_lost or not reading.has_message for reading in readings)
        has_stopped = is_lost or any(below.stopped for below in statuses)
        self.detail = next((below.reason for below in statuses if below.reason), "")
        if is_lost:
            self.detail = "its board is lost"
        has_left = (
            any(below.holding for below in statuses) and self._following_cycles > HANDOVER_CYCLES
        )
        if has_stopped or has_left:
            self._following_cycles = 0
        if not has_stopped:
            if not self._following_cycles:
                # Start from the arm's position, at rest.
                self._point[0] = position
                self._point[1:] = 0.0
                self._curve = None
            self._following_cycles += 1
        return position

    def _classify_gripper(self, arm: ArmStatus) -> str:
        """Return the value of the condition `gripper`, and update whether an object is held."""
        self._gripper_wait_cycles = max(0, self._gripper_wait_cycles - 1)
        if self._gripper_wait_cycles or abs(arm.opening_velocity) > MAX_GRIPPER_REST_M_S:
            return "moving"
        gripper = self._gripper
        if not self._closed:
            is_open = abs(arm.opening - gripper.open) <= GRIPPER_TOLERANCE_M
            self._held = False
            return "open" if is_open else "moving"
        self._held = abs(arm.opening - gripper.closed) > GRIPPER_TOLERANCE_M
        return "holds" if self._held else "empty"

    def do_begin(self) -> None:
        """Start the motion to the goal of the newest command.

        A motion must start at rest. If the arm is moving, this only halts it.
        """
        if self._curve is not None:
            self.do_halt()
            return
        start = self._point[0]
        limits = self._limits
        goal = np.clip(self._goal, limits.position[:, 0], limits.position[:, 1])
        self._end[:] = goal
        speed = min(max(self._speed, MIN_SPEED), 1.0)
        if np.abs(goal - start).max() > MIN_MOTION_RAD:
            self._start_curve(
                Passage(start, goal, speed * limits.velocity, speed * limits.acceleration)
            )

    def do_halt(self) -> None:
        """Ramp the joints to rest."""
        if self._curve is not None:
            self._start_curve(Ramp(self._point[0], self._point[1], self._limits.acceleration))

    def _start_curve(self, curve: Curve) -> None:
        """Start a curve at the set point of the previous cycle."""
        self._curve = curve
        self._curve_start_tick = self._due_tick - self.context.every

    @property
    def _passed_s(self) -> float:
        """Time, in s, from the start of the curve to the due tick of this cycle's set point."""
        return (self._due_tick - self._curve_start_tick) * self.context.tick_s

    def do_open(self) -> None:
        """Open the gripper."""
        self._closed = False
        self._gripper_wait_cycles = GRIP_CYCLES
        self._held_row = -1

    def do_close(self) -> None:
        """Close the gripper on the object of the newest command."""
        self._closed = True
        self._gripper_wait_cycles = GRIP_CYCLES
        self._held_row = self._target_row

    def write_outputs(self, tick: int) -> None:
        """Write the set point with inertia and load, and the status fields that a restart needs."""
        command = self.command
        status = self.status
        if self._curve is not None:
            self._point[:] = self._curve.compute_motion(self._passed_s).table
        command.id = tick // self.context.every + 1
        command.due = self._due_tick if self._following_cycles else 0
        command.position, command.velocity, command.acceleration = self._point
        mass = 0.0
        if self._held and self._held_row >= 0:
            mass = self._masses[self._held_row]
        load = Payload(mass, np.zeros(3))
        inertia, bias = self._dynamics.terms(self._point[0], self._point[1], load)
        command.inertia = np.diagonal(inertia)
        command.load = bias
        command.opening = self._gripper.closed if self._closed else self._gripper.open
        command.force = self._gripper.force
        command.payload_mass = mass
        status.position = self._point[0]
        status.end = self._end
        status.moving = not self.resting
        status.closed = self._closed
        status.held = self._held
        status.object = self._held_row if self._held else -1
