"""The elemental move level as a state table: pick and place by poses taught relative to an object
or a place.

The plan is static: heights above what is to be reached, at a speed each. The executor computes the
joints of a pose when a row says `move`, from the object's place as sensed, in bounded time.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pydantic import Field as Key

from rack.backplane.message import Field, Message, status
from rack.levels.algebra import Array, norm
from rack.levels.level import Input, LevelContext, Ports
from rack.levels.messages import WORLD_MODEL
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import Pose, pointing, yaw_of
from rack.levels.robot.cell import build_cell
from rack.levels.systems.state_table.level import (
    BELOW,
    STATUS_HEAD,
    WORD_COMMAND,
    YES_NO,
    StateTableExecutor,
    answer_of,
    vocabulary,
)
from rack.levels.systems.state_table.primitive import JOINT_MOVE, JOINT_MOVE_STATUS
from rack.levels.systems.state_table.table import Name, Place
from rack.levels.systems.state_table.vocabulary import Condition, Lexicon, Phrase
from rack.levels.tables import Finite, NotNegative, Positive, SceneConfig, Table

DOWN = (0.0, 0.0, -1.0)
HOME = "home"
"""The pose in which the arm starts."""
STILL_M_S = 0.005
"""An object slower than this rests."""
MOVE_TABLE_STATUS = status(
    "move_table_status",
    1,
    *STATUS_HEAD,
    Field("sent", "u4", "1", "serial of the newest command sent down; 0: none"),
    Field("reached", "u1", "1", "1: the newest pose has joint positions"),
    Field("put", "i2", "1", "row of the object put down last; -1: none"),
    Field("resting", "u1", "1", "1: the arm rests"),
)


class TaughtPoseConfig(Table):
    """`[plan.pose.<name>]`: a pose of the tool, pointing down, relative to an object or a place."""

    height: Finite = Key(description="of the tool above its origin, m")
    speed: Positive = Key(1.0, le=1.0, description="part of the joints' limits on the way there")


class MovePlanConfig(Table):
    """`[plan]` of the elemental move level's table."""

    pose: dict[Name, TaughtPoseConfig] = Key(min_length=1, description="poses by name")
    place: dict[Name, Place] = Key({}, description="origin of an object put there, m, by name")
    moved: NotNegative = Key(
        0.01,
        description=(
            "distance from where it was sensed , or should stand, at which an object is"
            " displaced, m"
        ),
    )
    home_speed: Positive = Key(
        1.0, le=1.0, description="part of the joints' limits on the way home"
    )


class MoveTable(StateTableExecutor):
    """Picks an object, puts it down at a place, goes home, pose by pose as its table says."""

    inputs = {
        "command": Input(WORD_COMMAND, "above.command", many=True, optional=True),
        "status": Input(JOINT_MOVE_STATUS, "below.status"),
        "world": Input(WORLD_MODEL, "world.model"),
        "last_command": Input(JOINT_MOVE, "own.command"),
        "last_status": Input(MOVE_TABLE_STATUS, "own.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"command": JOINT_MOVE, "status": MOVE_TABLE_STATUS}
    vocabulary = vocabulary(
        conditions={
            "below": BELOW,
            "world": Condition(("seen", "unseen"), "whether the objects are sensed"),
            "target": Condition(
                ("there", "displaced", "moving"),
                "the object to pick: there: where it was sensed for the newest `move`; a place is"
                " always there",
            ),
            "support": Condition(
                ("there", "elsewhere"), "where the object put down last rests: at its place, or not"
            ),
            "gripper": Condition(("free", "holds"), "whether the gripper holds something"),
            "reach": Condition(YES_NO, "whether the newest pose has joint positions"),
        },
        commands={
            "pick": Phrase(("object",), "take an object"),
            "place": Phrase(("place",), "put what the gripper holds at a place"),
            HOME: Phrase((), "go where the arm starts"),
        },
        actions={
            "move": Phrase(
                ("pose",), "go to a pose, relative to the object or place of the command in force"
            ),
            "open": Phrase((), "open the gripper"),
            "close": Phrase((), "close the gripper"),
        },
        plan=MovePlanConfig,
    )

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._cell = build_cell(context.robot, context.scene, context.clock_ns)
        self._ik = InverseKinematics(self._cell, context.seed)
        self._sent = 0
        self._reached = True
        self._what, self._speed = "", 1.0  # the newest command sent down
        self._joints = self._cell.home.copy()  # (joints,), rad: where it ends
        self._aim = np.zeros(3)  # m: where the object, or the place, was for it
        self._yaw = 0.0  # rad: likewise
        self._holds = False  # the gripper holds something
        self._carried = (
            self._put
        ) = -1  # rows of the object in it, and of the one put down last; -1: none
        self._row = -1  # of that object in the world model; -1: it was a place
        self._positions: Array = np.zeros((context.sizes["bodies"], 3))  # m, as sensed
        self._quaternions: Array = np.zeros((context.sizes["bodies"], 4))

    @classmethod
    def lexicon(cls, scene: SceneConfig, plan: Any) -> Lexicon:
        """Return objects, places and poses."""
        return {"object": scene.objects, "place": tuple(plan.place), "pose": (*plan.pose, HOME)}

    def recall(self, read: Ports, write: Ports) -> None:
        """Continue with the command sent down last."""
        super().recall(read, write)
        if read.last_status.is_there and read.last_command.is_there:
            last = read.last_command.value
            write.command.copy_from(last)
            self._sent = read.last_status.value.sent
            self._reached = bool(read.last_status.value.reached)
            self._put = read.last_status.value.put
            self._what = last.words
            self._speed = last.speed
            self._row = last.object
            self._joints[:] = last.joints
            self._aim[:] = last.aim
            self._yaw = last.yaw

    def look(self, read: Ports, tick: int) -> dict[str, str]:
        """Return where the level below, the object and the gripper are."""
        below = read.status.value
        world = read.world.value
        self.detail = below.reason
        self.resting = not below.moving
        self._holds = below.held > 0
        self._carried = below.object if below.held else -1
        self._positions = world.position
        self._quaternions = world.quaternion
        is_seen = not read.world.is_lost and world.revision > 0
        return {
            "below": answer_of(read.status, self._sent),
            "world": "seen" if is_seen else "unseen",
            "target": self._target(world) if is_seen else "moving",
            "support": (
                "there"
                if not is_seen or self._put < 0 or self._is_at(world, self._put)
                else "elsewhere"
            ),
            "gripper": ("free", "holds")[self._holds],
            "reach": YES_NO[self._reached],
        }

    def _target(self, world: Message) -> str:
        if self._row < 0:
            return "there"
        if norm(world.velocity[self._row]) > STILL_M_S:
            return "moving"
        return "there" if self._is_at(world, self._row) else "displaced"

    def _is_at(self, world: Message, row: int) -> bool:
        """Return whether an object is where the newest motion aims."""
        return bool(norm(world.position[row] - self._aim) <= self.table.plan.moved)

    def do_move(self, pose: str) -> None:
        """Send the arm to a pose."""
        if pose == HOME:
            self._send("move", self._cell.home, self.table.plan.home_speed)
            self._row = -1
            return
        taught = self.table.plan.pose[pose]
        goal = self._tool_at(taught.height)
        found = self._solve(goal)
        self._reached = found is not None
        if found is not None:
            self._send("move", found, taught.speed)

    def do_open(self) -> None:
        """Open the gripper."""
        self._put = self._carried
        self._send("open", self._joints, 1.0)

    def do_close(self) -> None:
        """Close the gripper."""
        self._send("close", self._joints, 1.0)

    def _tool_at(self, height: float) -> Pose:
        """Return the pose of the tool, pointing down, at a height above the object or place of the
        command."""
        verb, *names = self.words
        now = self._ik.tool_at(self._joints)
        self._row = self.context.scene.objects.index(names[0]) if verb == "pick" else -1
        if self._row < 0:
            self._aim[:] = self.table.plan.place[names[0]]
            self._yaw = 0.0
        elif not self._holds:
            # In the gripper it moves with the arm: it is raised from where it was.
            self._aim[:] = self._positions[self._row]
            self._yaw = yaw_of(self._quaternions[self._row])
        above = self._aim + np.array([0.0, 0.0, height])
        # Across the object's faces, whichever quarter turn is nearest to the tool now.
        turns = [pointing(DOWN, -(self._yaw + quarter * 0.5 * math.pi)) for quarter in range(4)]
        return min((Pose(above, turn) for turn in turns), key=now.angle_to)

    def _solve(self, goal: Pose) -> Array | None:
        """Return joint positions, rad, at a pose: on the branch of the arm, else from home; at most
        three descents."""
        found = self._ik.nearby(goal, self._joints)
        if found is None:
            found = self._ik.reach(goal, self._cell.home)
        return found if found is not None else self._ik.reach(goal, self._joints)

    def _send(self, what: str, joints: Array, speed: float) -> None:
        self._sent += 1
        self._what = what
        self._speed = speed
        self._joints[:] = joints

    def give(self, write: Ports, tick: int) -> None:
        """Write the command, and what a restarted board needs."""
        command = write.command
        shown = write.status
        command.id = self._sent
        command.words = self._what
        command.hold = self.holds
        command.joints[:] = self._joints
        command.speed = self._speed
        command.object = self._row
        command.aim = self._aim
        command.yaw = self._yaw
        shown.sent = self._sent
        shown.reached = self._reached
        shown.resting = self.resting
        shown.put = self._put
