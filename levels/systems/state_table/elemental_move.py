"""The elemental move level as a state table: pick and place by poses taught relative to an object
or a place.

The plan is static: heights above what is to be reached, at a speed each. The executor computes the
joints of a pose when a row says `move`, from the object's place as sensed, in bounded time.
"""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field as Key

from rack.backplane.message import field, integer
from rack.levels.algebra import Array, norm
from rack.levels.level import Input, Inputs, LevelContext, Output
from rack.levels.messages import WorldState
from rack.levels.operator import OperatorCommand
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import Pose, pointing, yaw_of
from rack.levels.robot.cell import cell_of
from rack.levels.systems.state_table.level import (
    BELOW,
    YES_NO,
    StateTableExecutor,
    TableCommand,
    TableStatus,
    answer_of,
    vocabulary,
)
from rack.levels.systems.state_table.primitive import JointMove, JointMoveStatus
from rack.levels.systems.state_table.table import Lexicon, Name, Place
from rack.levels.tables import Finite, NotNegative, Positive, SceneConfig, Table

DOWN = (0.0, 0.0, -1.0)
HOME = "home"
"""The pose in which the arm starts."""
STILL_M_S = 0.005
"""An object slower than this rests."""


class MoveTableStatus(TableStatus, version=1):
    """Status of the elemental move level of state tables."""

    sent: int = integer("serial of the newest command sent down; 0: none")
    reached: bool = field(doc="1: the newest pose has joint positions")
    put: int = integer("row of the object put down last; -1: none", "i2")
    resting: bool = field(doc="1: the arm rests")


class TaughtPoseConfig(Table):
    """`[plan.pose.<name>]`: a pose of the tool, pointing down, relative to an object or a place."""

    height: Finite
    """of the tool above its origin [m]"""
    speed: Positive = Key(1.0, le=1.0)
    """part of the joints' limits on the way there"""


class MovePlanConfig(Table):
    """`[plan]` of the elemental move level's table."""

    pose: dict[Name, TaughtPoseConfig] = Key(min_length=1)
    """poses by name"""
    place: dict[Name, Place] = {}
    """origin of an object put there [m], by name"""
    moved: NotNegative = 0.01
    """distance from where it was sensed , or should stand, at which an object is displaced [m]"""
    home_speed: Positive = Key(1.0, le=1.0)
    """part of the joints' limits on the way home"""


class MoveTable(StateTableExecutor):
    """Picks an object, puts it down at a place, goes home, pose by pose as its table says."""

    above = Inputs(TableCommand, "above.command", optional=True)
    below = Input(JointMoveStatus, "below.status")
    world = Input(WorldState, "world.model")
    last_command = Input(JointMove, "own.command")
    last_status = Input(MoveTableStatus, "own.status")
    operator = Input(OperatorCommand, "own.operator")
    command = Output(JointMove, rests_on=above)
    status = Output(MoveTableStatus, rests_on=below)
    vocabulary = vocabulary(
        conditions={
            "below": BELOW,
            # Whether the objects are sensed.
            "world": ("seen", "unseen"),
            # The object to pick: there: where it was sensed for the newest `move`; a place is
            # always there.
            "target": ("there", "displaced", "moving"),
            # Where the object put down last rests: at its place, or not.
            "support": ("there", "elsewhere"),
            # Whether the gripper holds something.
            "gripper": ("free", "holds"),
            # Whether the newest pose has joint positions.
            "reach": YES_NO,
        },
        commands={
            "pick": ("object",),
            # What the gripper holds, at a place.
            "place": ("place",),
            HOME: (),
        },
        actions={
            # To a pose, relative to the object or place of the command in force.
            "move": ("pose",),
            "open": (),
            "close": (),
        },
        plan=MovePlanConfig,
    )
    _below: JointMoveStatus
    _world: WorldState
    """As of this cycle."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._cell = cell_of(context)
        self._ik = InverseKinematics(self._cell, context.seed)
        # The newest command sent down: it aims at a place, unless `object` is a row.
        self._command = JointMove.zeros(context.sizes)
        self._command.joints = self._cell.home
        self._command.speed = 1.0
        self._command.object = -1
        self._reached = True
        self._put = -1  # row of the object put down last; -1: none

    @classmethod
    def lexicon(cls, scene: SceneConfig, plan: Any) -> Lexicon:
        """Return objects, places and poses."""
        return {"object": scene.objects, "place": tuple(plan.place), "pose": (*plan.pose, HOME)}

    def recall(self) -> None:
        """Continue with the command sent down last."""
        super().recall()
        if self.last_status.is_there and self.last_command.is_there:
            last = self.last_status.message
            self._command.copy_from(self.last_command.message)
            self._command.id = last.sent
            self._reached = last.reached
            self._put = last.put

    def look(self, tick: int) -> dict[str, str]:
        """Return where the level below, the object and the gripper are."""
        self._below = self.below.message
        self._world = self.world.message
        self.detail = self._below.reason
        self.resting = not self._below.moving
        is_seen = not self.world.is_lost and self._world.revision > 0
        target = "moving"
        is_elsewhere = False
        if is_seen:
            target = self._target(self._command.object)
            is_elsewhere = self._put >= 0 and not self._is_at(self._put)
        return {
            "below": answer_of(self.below, self._command.id),
            "world": ("unseen", "seen")[is_seen],
            "target": target,
            "support": ("there", "elsewhere")[is_elsewhere],
            "gripper": ("free", "holds")[self._below.held],
            "reach": YES_NO[self._reached],
        }

    def _target(self, row: int) -> str:
        if row < 0:
            return "there"
        if norm(self._world.velocity[row]) > STILL_M_S:
            return "moving"
        return "there" if self._is_at(row) else "displaced"

    def _is_at(self, row: int) -> bool:
        """Return whether an object is where the newest motion aims."""
        distance = norm(self._world.position[row] - self._command.aim)
        return bool(distance <= self.table.plan.moved)

    def do_move(self, pose: str) -> None:
        """Send the arm to a pose."""
        if pose == HOME:
            self._send("move", self._cell.home, self.table.plan.home_speed)
            self._command.object = -1
            return
        taught = self.table.plan.pose[pose]
        goal = self._tool_at(taught.height)
        joints = None if goal is None else self._solve(goal)
        self._reached = joints is not None
        if joints is not None:
            self._send("move", joints, taught.speed)

    def do_open(self) -> None:
        """Open the gripper."""
        self._put = self._below.object if self._below.held else -1
        self._send("open", self._command.joints, 1.0)

    def do_close(self) -> None:
        """Close the gripper."""
        self._send("close", self._command.joints, 1.0)

    def _tool_at(self, height: float) -> Pose | None:
        """Return the pose of the tool, pointing down, at a height above the object or place of the
        command; None: a command without either, or none, is in force.
        """
        if len(self.words) < 2:
            return None
        verb, name = self.words
        command = self._command
        if verb == "place":
            command.object = -1
            command.aim = self.table.plan.place[name]
            command.yaw = 0.0
        else:
            row = command.object = self.context.scene.objects.index(name)
            # In the gripper it moves with the arm: it is raised from where it was.
            if not self._below.held:
                command.aim = self._world.position[row]
                command.yaw = yaw_of(self._world.quaternion[row])
        now = self._ik.tool_at(command.joints)
        # Across the object's faces, whichever quarter turn is nearest to the tool now.
        turns = [pointing(DOWN, -(command.yaw + quarter * 0.5 * math.pi)) for quarter in range(4)]
        goals = [Pose(command.aim, turn).raised(height) for turn in turns]
        return min(goals, key=now.angle_to)

    def _solve(self, goal: Pose) -> Array | None:
        """Return joint positions, rad, at a pose: on the branch of the arm, else from home; at most
        three descents.
        """
        joints = self._ik.nearby(goal, self._command.joints)
        if joints is None:
            joints = self._ik.reach(goal, self._cell.home)
        return joints if joints is not None else self._ik.reach(goal, self._command.joints)

    def _send(self, what: str, joints: Array, speed: float) -> None:
        self._command.id += 1
        self._command.words = what
        self._command.speed = speed
        self._command.joints = joints

    def give(self, tick: int) -> None:
        """Write the command, and what a restarted board needs."""
        shown = self.status
        self._command.hold = self.holds
        self.command.copy_from(self._command)
        shown.sent = self._command.id
        shown.reached = self._reached
        shown.resting = self.resting
        shown.put = self._put
