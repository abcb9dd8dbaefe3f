"""The executor of a board of the arm: applies the torques of the boards that servo its joints."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.arm.commands_above import CommandsAbove, check_commanders, describe_commanders
from rack.levels.level import OPERATOR, Input, Inputs, LevelContext, Mismatches, Output, Reading
from rack.levels.messages import ArmState
from rack.levels.operator import DRIVE_OPERATIONS, HOLD_COMMANDS, OperatorCommand
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Payload
from rack.levels.servo.arm_report import SetPointStatus, view_numbers
from rack.levels.servo.curves import Motion
from rack.levels.servo.driver import SCENES, ArmDriver
from rack.levels.servo.reference import ASTRAY_RAD
from rack.levels.servo.stopping import Reaction
from rack.levels.systems.joint_boards.messages import ArmStatus, JointTorque

HELD = "held by the operator; `resume` releases it"


class JointTorques(CommandsAbove):
    """Adds up the `JointTorque` messages of the boards above.

    The values of a message are 0 for joints that its board does not drive.

    Attributes:
        torque: Torques of all boards, (joints,), N m.
        wanted: Motion commanded by the boards. Its accelerations are not known.
        moves: True if a commanded velocity is not zero.
        rests_on: Serial of the newest operator's command on which the torques are based.
    """

    def __init__(self, context: LevelContext, cell: Cell) -> None:
        super().__init__(context, cell.patience, 1, "torque", "braked")
        joints = len(cell.home)
        # The fields of a `JointTorque` from `torque` to `payload_offset`.
        self._sum = np.zeros(3 * joints + 5)
        self.torque = self._sum[:joints]
        self.wanted = Motion(np.zeros((3, joints)))
        self.moves = False
        self.rests_on = 0

    @property
    def grip_force(self) -> float:
        """Force of the gripper, in N."""
        return float(self._sum[-5])

    @property
    def payload(self) -> Payload:
        """Payload in the gripper according to the boards."""
        return Payload(float(self._sum[-4]), self._sum[-3:])

    def sum_commands(self, commands: Mapping[str, Reading[JointTorque]]) -> None:
        """Add up the commands of all boards. Call this only if none of them is missing."""
        self.rests_on = 0
        self._sum[:] = 0.0
        for board in self.oldest:
            value = commands[board].message
            self.rests_on = max(self.rests_on, value.operator)
            self._sum += view_numbers(value, "torque", "payload_offset")
        joints = len(self.torque)
        self.wanted.table[:2] = self._sum[joints : 3 * joints].reshape(2, joints)
        self.moves = bool(self.wanted.velocity.any())


class ArmExecutor(ArmDriver):
    """Drives an arm with the torques of the boards above. Either all joints are driven or none.

    While it reports `stopped`, these boards must bring the joints to rest and hold them. If they do
    not do so in time, the arm is braked. It is also braked if a board is lost or late. The brakes
    are released once all boards have received the status that reports them. From that cycle on, the
    torques of the boards hold the arm. See `ArmDriver`.
    """

    joint_torques = Inputs(JointTorque, "above.command")
    before = Input(ArmState, "own.state")
    operator = OPERATOR
    status = Output(ArmStatus)
    state = Output(ArmState)
    scene = SCENES
    commands = {**HOLD_COMMANDS, **dict.fromkeys(DRIVE_OPERATIONS, ())}

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        limits = self.cell.limits
        self.joints = JointTorques(context, self.cell)
        rest_s = float(np.max(limits.velocity / limits.acceleration))
        self._rest_ticks = round(rest_s / context.tick_s) + max(self.joints.oldest.values())
        self._defied = False  # the boards above have not brought the arm to rest in time
        # Tick by which the arm must be at rest, or None.
        self._rest_by: int | None = None
        # Tick of the first status that reports the brakes, or None.
        self._braked_at: int | None = None
        self._torques: Mapping[str, Reading[JointTorque]] = {}
        self._waiting = ""  # why the boards above do not drive the arm

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield a mismatch if a joint or the gripper is not driven by exactly one board above.

        Also yield the mismatches of `ArmDriver`.
        """
        yield from super().find_mismatches(context)
        everything = context.robot.joints
        wanted = {
            board: pace.params.get("joints", everything) for board, pace in context.above.items()
        }
        yield from check_commanders(context, wanted)
        grips = [
            board for board, pace in context.above.items() if pace.params.get("gripper", False)
        ]
        if len(grips) != (context.robot.gripper is not None):
            text = "the gripper must be commanded by one board"
            if context.robot.gripper is None:
                text = "the arm has no gripper"
            yield "above", list(wanted), f"{text}; {describe_commanders(grips)}"

    def process(self, tick: int) -> None:
        """Run the cycle of an arm, and write its tick to the status."""
        self.status.tick = tick
        super().process(tick)

    def take_messages(self) -> None:
        """Read the torques of the boards above and the commands of the operator."""
        self._torques = self.joint_torques
        self._orders.take_commands(self.operator, self._process_command)

    def _process_command(self, command: OperatorCommand) -> None:
        """Carry out or refuse a command to the drives. Ignore other commands."""
        if command.what in DRIVE_OPERATIONS and (refusal := self.obey_drive_command(command)):
            self._orders.refuse_newest(refusal)

    def next_motion(self, reaction: Reaction, missed: bool, tick: int) -> Motion | None:
        """Return the motion commanded by the boards above, or None if the arm must be braked."""
        if self.arm.braked and self._braked_at is None:
            self._waiting = "braked until the boards above have seen it"
            return None
        stops = reaction > 0 or self._orders.is_holding
        self._defied = self._defied and stops
        if self._defied or (reaction is Reaction.STOP and self.abandoned):
            return None
        self._waiting = self.joints.find_missing(self._torques, tick, self._braked_at or 0)
        if self._waiting:
            return None
        self.joints.sum_commands(self._torques)
        self.payload = self.joints.payload
        self.holds_part = self.payload.mass > 0.0
        self.rests_on = self.joints.rests_on
        if self.abandoned and self._is_astray():
            return None
        self._defied = self._is_rest_overdue(stops, tick) and self.joints.moves
        if self._defied:
            self._waiting = "braked: the boards above did not bring it to rest"
            return None
        self._braked_at = None
        if self._orders.is_holding and not self.joints.moves:
            self._orders.report_done()
        return self.joints.wanted

    def _is_astray(self) -> bool:
        """Return True if the boards above command a position too far from that of the arm.

        This happens for two cycles when sensors are trusted again and their position differs from
        the estimate.
        """
        distance = self.joints.wanted.position - self.sensors.position
        joint = int(np.abs(distance).argmax())
        if abs(distance[joint]) <= ASTRAY_RAD:
            return False
        name = self.context.robot.joints[joint]
        self._waiting = (
            f"braked: joint '{name}' is wanted more than {ASTRAY_RAD:g} rad away from where it is"
        )
        return True

    def _is_rest_overdue(self, stops: bool, tick: int) -> bool:
        """Return True if the time for the boards above to bring the arm to rest is over.

        Args:
            stops: True if the arm must stop.
            tick: Tick of the cycle.
        """
        if not stops:
            self._rest_by = None
        elif self._rest_by is None:
            self._rest_by = tick + self._rest_ticks
        return self._rest_by is not None and tick >= self._rest_by

    def brake_arm(self) -> None:
        """Engage the brakes until the boards above have received a status that reports them."""
        if self._braked_at is None:
            self._braked_at = self.arm.tick
        self._rest_by = None
        super().brake_arm()

    def compute_efforts(self, wanted: Motion, sensed: Sensed) -> tuple[Array, float]:
        """Return the torques of the boards above in N m, and their grip force in N."""
        return self.joints.torque, self.joints.grip_force

    def report_set_points(self, reaction: Reaction) -> SetPointStatus:
        """Return the section of the status that reports the set points of the boards above."""
        is_held = self._orders.is_holding
        reason = self.stopping.reason or self._waiting
        if is_held and not reason:
            reason = HELD
        holding = self.abandoned or not self.joints.moves
        stopped = self.abandoned or reaction > 0 or is_held
        return SetPointStatus(0, holding, stopped, 0, reason, has_work=True)
