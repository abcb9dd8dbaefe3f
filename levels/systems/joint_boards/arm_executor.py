"""The executor of a board of the arm: gives it the torques of the boards that servo its joints, or
brakes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.arm.commands_above import CommandsAbove
from rack.levels.level import Input, Inputs, LevelContext, Misfits, Output, Reading
from rack.levels.messages import ArmState
from rack.levels.operator import DRIVES, HOLDABLE, OperatorCommand, Orders
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Payload
from rack.levels.servo.arm_report import SetPointStatus, numbers
from rack.levels.servo.curves import Motion
from rack.levels.servo.driver import SCENES, ArmDriver
from rack.levels.servo.reference import ASTRAY_RAD
from rack.levels.servo.stopping import Reaction
from rack.levels.systems.joint_boards.messages import ArmStatus, JointTorque

HELD = "held by the operator; `resume` releases it"


class JointTorques(CommandsAbove):
    """Adds up the `JointTorque`s of the boards above; each is 0 for the joints of other boards."""

    def __init__(self, context: LevelContext, cell: Cell) -> None:
        super().__init__(context, cell.patience, 1, "torque", "braked")
        joints = len(cell.home)
        # The fields of a `JointTorque` from `torque` to `payload_offset`.
        self._sum = np.zeros(3 * joints + 5)
        self.torque = self._sum[:joints]  # (joints,), N m
        # Where the boards want the joints; accelerations are not known.
        self.wanted = Motion(np.zeros((3, joints)))
        self.moves = False  # a joint is wanted to move
        self.rests_on = 0  # serial of the newest command of an operator that the torques rest on

    @property
    def grip_force(self) -> float:
        """The gripper's force, N."""
        return float(self._sum[-5])

    @property
    def payload(self) -> Payload:
        """The mass in the gripper, as the boards know it."""
        return Payload(float(self._sum[-4]), self._sum[-3:])

    def add_up(self, commands: Mapping[str, Reading[JointTorque]]) -> None:
        """Set `torque`, `wanted`, `grip_force` and `payload`, while nothing is `missing`."""
        self.rests_on = 0
        self._sum[:] = 0.0
        for board in self.oldest:
            value = commands[board].message
            self.rests_on = max(self.rests_on, value.operator)
            self._sum += numbers(value, "torque", "payload_offset")
        joints = len(self.torque)
        self.wanted.table[:2] = self._sum[joints : 3 * joints].reshape(2, joints)
        self.moves = bool(self.wanted.velocity.any())


class ArmExecutor(ArmDriver):
    """Drives an arm with the torques of the boards above: all of its joints, or none.

    While it says `stopped`, these boards bring the joints to rest and hold them; an arm that is
    still not at rest after the time that this takes is braked. A board that is lost or late brakes
    the arm. It is released when all boards have seen that it was braked: their torques then hold it
    where it is. See `ArmDriver`.
    """

    joint_torques = Inputs(JointTorque, "above.command")
    before = Input(ArmState, "own.state")
    operator = Input(OperatorCommand, "own.operator")
    status = Output(ArmStatus)
    state = Output(ArmState)
    scene = SCENES
    commands = {**HOLDABLE, **dict.fromkeys(DRIVES, ())}

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        limits = self.cell.limits
        self.joints = JointTorques(context, self.cell)
        self.orders = Orders(self.commands)
        rest_s = float(np.max(limits.velocity / limits.acceleration))
        self._rest_ticks = round(rest_s / context.tick_s) + max(self.joints.oldest.values())
        self._defied = False  # the boards above have not brought it to rest in that time
        # Tick by which the arm must have come to rest; None: it need not.
        self._rest_by: int | None = None
        # Tick of the first status that said so; None: not braked, or not yet said.
        self._braked_at: int | None = None
        self._torques: Mapping[str, Reading[JointTorque]] = {}
        self._waiting = ""  # why the boards above do not drive the arm

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield every joint, and the gripper, that not exactly one board above drives, and what
        `ArmDriver` yields.
        """
        yield from super().misfits(context, above, below)
        everything = context.robot.joints
        wanted = {other.board: other.params.get("joints", everything) for other in above}
        for joint in everything:
            boards = [board for board, joints in wanted.items() if joint in joints]
            if len(boards) != 1:
                yield (
                    "above",
                    list(wanted),
                    f"joint '{joint}' must be commanded by one board; {_by(boards)}",
                )
        grips = [other.board for other in above if other.params.get("gripper", False)]
        if len(grips) != (context.robot.gripper is not None):
            must = "the gripper must be commanded by one board"
            if context.robot.gripper is None:
                must = "the arm has no gripper"
            yield "above", list(wanted), f"{must}; {_by(grips)}"

    def process(self, tick: int) -> None:
        """Advance the arm to `tick`, sense, drive or brake, report."""
        self.status.tick = tick
        super().process(tick)

    def take_messages(self) -> None:
        """Take over what is new."""
        self._torques = self.joint_torques
        self.orders.take(self.operator, self._judge)

    def _judge(self, command: OperatorCommand) -> None:
        """Obey what leaves the command in force as it is, or refuse it."""
        if command.what in DRIVES and (why := self.obey(command)):
            self.orders.refuse(why)

    def next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion | None:
        """Return where the boards above want the arm; None: not all of them drive it."""
        if self.arm.braked and self._braked_at is None:
            self._waiting = "braked until the boards above have seen it"
            return None
        stops = reaction > 0 or self.orders.holds
        self._defied = self._defied and stops
        if self._defied or (reaction is Reaction.STOP and self.abandoned):
            return None
        self._waiting = self.joints.missing(self._torques, tick, self._braked_at or 0)
        if self._waiting:
            return None
        self.joints.add_up(self._torques)
        self.rests_on = self.joints.rests_on
        if self.abandoned and self._is_astray():
            return None
        self._defied = self._must_rest(stops, tick) and self.joints.moves
        if self._defied:
            self._waiting = "braked: the boards above did not bring it to rest"
            return None
        self._braked_at = None
        if self.orders.holds and not self.joints.moves:
            self.orders.done()
        return self.joints.wanted

    def _is_astray(self) -> bool:
        """Return whether the boards above want the arm elsewhere than where it is braked.

        They do for two cycles when sensors are trusted again and show another position than was
        estimated.
        """
        away = self.joints.wanted.position - self.sensors.position
        joint = int(np.abs(away).argmax())
        if abs(away[joint]) <= ASTRAY_RAD:
            return False
        name = self.context.robot.joints[joint]
        self._waiting = (
            f"braked: joint '{name}' is wanted more than {ASTRAY_RAD:g} rad away from where it is"
        )
        return True

    def _must_rest(self, stops: bool, tick: int) -> bool:
        """Return whether the arm `stops`, and the boards above have had enough time to bring it to
        rest.
        """
        if not stops:
            self._rest_by = None
        elif self._rest_by is None:
            self._rest_by = tick + self._rest_ticks
        return self._rest_by is not None and tick >= self._rest_by

    def brake(self) -> None:
        """Brake, until the boards above have seen it."""
        if self._braked_at is None:
            self._braked_at = self.arm.tick
        self._rest_by = None
        super().brake()

    def efforts(self, wanted: Motion, sensed: Sensed) -> tuple[Array, float]:
        """Return the torques of the boards above, N m, and their grip force, N."""
        return self.joints.torque, self.joints.grip_force

    @property
    def payload(self) -> Payload:
        """What the gripper holds, by the boards above."""
        return self.joints.payload

    @property
    def holds(self) -> bool:
        """Whether the gripper holds a part, by the boards above."""
        return self.payload.mass > 0.0

    def course(self, reaction: Reaction) -> SetPointStatus:
        """Return what the status says of the torques from above."""
        held = self.orders.holds
        kept = self.stopping.reason or self._waiting
        if held and not kept:
            kept = HELD
        holding = self.abandoned or not self.joints.moves
        stopped = self.abandoned or reaction > 0 or held
        return SetPointStatus(0, holding, stopped, 0, kept, has_work=True)


def _by(boards: Sequence[str]) -> str:
    named = ", ".join(f"'{board}'" for board in boards)
    return f"it is commanded by {named or 'none'}"
