"""The elemental move level as a state table.

It picks and places with taught poses relative to an object or a place. The plan is static: each
pose has a height above the object or place, and a speed. When a row says `move`, the executor
computes joint positions from the sensed pose of the object, in bounded time.
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field as Key

from rack.backplane.message import field, integer_field
from rack.levels.algebra import Array, norm
from rack.levels.level import OPERATOR, Input, Inputs, LevelContext, Output
from rack.levels.messages import WorldState
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import Pose, build_pointing_quaternion, compute_yaw
from rack.levels.robot.cell import build_level_cell
from rack.levels.systems.state_table.level import (
    BELOW,
    YES_NO,
    StateTableExecutor,
    TableCommand,
    TableStatus,
    build_vocabulary,
    classify_answer,
)
from rack.levels.systems.state_table.primitive import JointMove, JointMoveStatus
from rack.levels.systems.state_table.table import Lexicon, Name, Place
from rack.levels.tables import Finite, NotNegative, Positive, SceneConfig, Table

DOWN = (0.0, 0.0, -1.0)
HOME = "home"
"""Name of the pose in which the arm starts."""
MAX_REST_SPEED_M_S = 0.005
"""An object slower than this is at rest."""


class MoveTableStatus(TableStatus, version=1):
    """Status of the elemental move level of state tables."""

    sent: int = integer_field("serial of the newest command sent down (0: none)")
    reached: bool = field(doc="1: the newest pose has joint positions")
    put: int = integer_field("row of the object put down last (-1: none)", "i2")
    resting: bool = field(doc="1: the arm rests")


class TaughtPoseConfig(Table):
    """`[plan.pose.<name>]`: pose of the tool, pointing down, relative to an object or a place."""

    height: Finite
    """height of the tool above the origin of the object or place [m]"""
    speed: Positive = Key(1.0, le=1.0)
    """fraction of the joints' limits on the way to the pose"""


class MovePlanConfig(Table):
    """`[plan]` of the elemental move level's table."""

    pose: dict[Name, TaughtPoseConfig] = Key(min_length=1)
    """poses by name"""
    place: dict[Name, Place] = {}
    """origin of an object after it was put at the place [m], by name"""
    moved: NotNegative = 0.01
    """distance from its sensed or intended position beyond which an object is displaced [m]"""
    home_speed: Positive = Key(1.0, le=1.0)
    """fraction of the joints' limits on the way home"""


class MoveTable(StateTableExecutor):
    """Executor that picks objects, puts them at places and moves home, pose by pose."""

    above = Inputs(TableCommand, "above.command", optional=True)
    below = Input(JointMoveStatus, "below.status")
    world = Input(WorldState, "world.model")
    last_command = Input(JointMove, "own.command")
    last_status = Input(MoveTableStatus, "own.status")
    operator = OPERATOR
    command = Output(JointMove, rests_on=above)
    status = Output(MoveTableStatus, rests_on=below)
    vocabulary = build_vocabulary(
        conditions={
            "below": BELOW,
            # Whether the objects are sensed.
            "world": ("seen", "unseen"),
            # `there`: the object to pick rests where it was sensed for the newest `move`. A place
            # is always `there`.
            "target": ("there", "displaced", "moving"),
            # Whether the object put down last rests at its place.
            "support": ("there", "elsewhere"),
            # Whether the gripper holds something.
            "gripper": ("free", "holds"),
            # Whether the newest pose has joint positions.
            "reach": YES_NO,
        },
        commands={
            "pick": ("object",),
            # Put the held object at a place.
            "place": ("place",),
            HOME: (),
        },
        actions={
            # Go to a pose relative to the object or place of the current command.
            "move": ("pose",),
            "open": (),
            "close": (),
        },
        plan=MovePlanConfig,
    )
    # Status of the level below and world model, as read in this cycle.
    _below_status: JointMoveStatus
    _world: WorldState

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._cell = build_level_cell(context)
        self._ik = InverseKinematics(self._cell, context.seed)
        self._reached = True
        self._put_row = -1  # row of the object put down last, -1 if there is none

    @classmethod
    def build_lexicon(cls, scene: SceneConfig, plan: Any) -> Lexicon:
        """Return the names of the objects, places and poses."""
        return {"object": scene.objects, "place": tuple(plan.place), "pose": (*plan.pose, HOME)}

    def restore_state(self) -> None:
        """Restore the newest command to the level below after a restart."""
        super().restore_state()
        # It aims at a place if `object` is -1.
        self.command.joints = self._cell.home
        self.command.speed = 1.0
        self.command.object = -1
        if self.last_status.has_message and self.last_command.has_message:
            last = self.last_status.message
            self.command.copy_from(self.last_command.message)
            self.command.id = last.sent
            self._reached = last.reached
            self._put_row = last.put

    def evaluate_conditions(self, tick: int) -> dict[str, str]:
        """Return the values of the conditions on the level below, the objects and the gripper."""
        self._below_status = self.below.message
        self._world = self.world.message
        self.detail = self._below_status.reason
        self.resting = not self._below_status.moving
        is_seen = not self.world.is_lost and self._world.revision > 0
        target = "moving"
        is_elsewhere = False
        if is_seen:
            target = self._classify_target(self.command.object)
            is_elsewhere = self._put_row >= 0 and not self._is_at_aim(self._put_row)
        return {
            "below": classify_answer(self.below, self.command.id),
            "world": ("unseen", "seen")[is_seen],
            "target": target,
            "support": ("there", "elsewhere")[is_elsewhere],
            "gripper": ("free", "holds")[self._below_status.held],
            "reach": YES_NO[self._reached],
        }

    def _classify_target(self, row: int) -> str:
        """Return the value of the condition `target`.

        Args:
            row: Index of the target object in the world model. -1 if the target is a place.
        """
        if row < 0:
            return "there"
        if norm(self._world.velocity[row]) > MAX_REST_SPEED_M_S:
            return "moving"
        return "there" if self._is_at_aim(row) else "displaced"

    def _is_at_aim(self, row: int) -> bool:
        """Return True if an object is within `plan.moved` of the aim of the newest motion."""
        distance = norm(self._world.position[row] - self.command.aim)
        return bool(distance <= self.table.plan.moved)

    def do_move(self, pose: str) -> None:
        """Send the arm to a taught pose, or home."""
        if pose == HOME:
            self._send_command("move", self._cell.home, self.table.plan.home_speed)
            self.command.object = -1
            return
        taught = self.table.plan.pose[pose]
        goal = self._find_tool_goal(taught.height)
        joints = None if goal is None else self._solve_joints(goal)
        self._reached = joints is not None
        if joints is not None:
            self._send_command("move", joints, taught.speed)

    def do_open(self) -> None:
        """Open the gripper."""
        self._put_row = self._below_status.object if self._below_status.held else -1
        self._send_command("open", self.command.joints, 1.0)

    def do_close(self) -> None:
        """Close the gripper."""
        self._send_command("close", self.command.joints, 1.0)

    def _find_tool_goal(self, height: float) -> Pose | None:
        """Return the tool's goal pose for the current command, with the tool pointing down.

        Args:
            height: Height above the object or place of the command, m.

        Returns:
            The goal, or None if the current command names neither an object nor a place.
        """
        if len(self.words) < 2:
            return None
        verb, name = self.words
        command = self.command
        if verb == "place":
            command.object = -1
            command.aim = self.table.plan.place[name]
            command.yaw = 0.0
        else:
            row = command.object = self.context.scene.objects.index(name)
            # A held object moves with the arm, so the aim stays at its position before the grasp.
            if not self._below_status.held:
                command.aim = self._world.position[row]
                command.yaw = compute_yaw(self._world.quaternion[row])
        tool_now = self._ik.compute_tool_pose(command.joints)
        # The gripper must be aligned with the object's faces. Of the four possible turns, take the
        # one nearest to the current orientation.
        turns = [
            build_pointing_quaternion(DOWN, -(command.yaw + quarter * 0.5 * math.pi))
            for quarter in range(4)
        ]
        goals = [Pose(command.aim, turn).raise_by(height) for turn in turns]
        return min(goals, key=tool_now.compute_angle)

    def _solve_joints(self, goal: Pose) -> Array | None:
        """Return joint positions, in rad, that reach a pose, or None if none are found.

        Positions near the arm's current configuration are preferred. At most three searches are
        made.
        """
        joints = self._ik.find_nearby(goal, self.command.joints)
        if joints is None:
            joints = self._ik.find_configuration(goal, self._cell.home)
        return (
            joints if joints is not None else self._ik.find_configuration(goal, self.command.joints)
        )

    def _send_command(self, words: str, joints: Array, speed: float) -> None:
        """Fill the command for the level below and give it a new serial."""
        self.command.id += 1
        self.command.words = words
        self.command.speed = speed
        self.command.joints = joints

    def write_outputs(self, tick: int) -> None:
        """Write the command, and the status fields that a restarted board needs."""
        status = self.status
        self.command.hold = self.is_held
        status.sent = self.command.id
        status.reached = self._reached
        status.resting = self.resting
        status.put = self._put_row
