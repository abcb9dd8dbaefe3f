"""Boards for the loops of a hand.

A board runs one loop of all fingers, or all loops of one finger, with the same laws. The fingertip
loop converts commands of the grasp loop to joint targets, the joint loop converts these to torques,
and the tendon loop converts torques to tensions.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Mask
from rack.levels.level import OPERATOR, Executor, Input, LevelContext, Mismatches, Output, Reading
from rack.levels.operator import (
    BELOW_LOST,
    HOLD_COMMANDS,
    OperatorCommand,
    RelayedCommand,
)
from rack.levels.robot import dynamics
from rack.levels.robot.cell import build_level_cell
from rack.levels.robot.hand import Hand
from rack.levels.systems.hand import laws
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.laws import (
    FingertipGains,
    FingertipLaw,
    JointGains,
    JointLaw,
    TendonGains,
    TendonLaw,
)
from rack.levels.systems.hand.messages import (
    FingerStatus,
    FingerTarget,
    GraspTarget,
    HandStatus,
    LoopStatus,
    TendonTorque,
    TensionCommand,
)
from rack.levels.tables import read_params

NO_HAND_YET = "no status of the hand yet: waiting for its board"
HAND_LOST = "no status of the hand: what was commanded last is kept"


class HandLoop(Executor):
    """Base of the loops between the level above and the hand.

    A loop follows the newest command, based on the sensed state of the hand. Without a fresh
    command it keeps following the last one, so that the hand keeps its grip. During an operator's
    hold the velocities of that command are set to zero. Commands that are not finite are rejected.
    A subclass has the ports "above", "command", "status", "hand", "operator" and, unless the hand
    is directly below, "below".
    """

    commands = HOLD_COMMANDS
    above: Reading[RelayedCommand]
    below: Reading[LoopStatus]
    hand: Reading[HandStatus]
    operator: Reading[OperatorCommand]
    command: RelayedCommand
    status: LoopStatus | FingerStatus
    followed: RelayedCommand
    """Command that the loop follows: the last one that was accepted."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.cell = build_level_cell(context)
        assert self.cell.hand is not None, "`find_mismatches` refuses a robot without a hand"
        self.hand_model: Hand = self.cell.hand
        command = self.inputs["above"].message
        self.followed = command.zeros(context.sizes)
        # Names of the fields that must be finite.
        self._numbers = [field.name for field in command.message_type.fields if field.kind == "f8"]
        self.commanded = False  # whether a command was accepted
        # Mask of the joints or fingers of this board, as in the status.
        self.driven: Mask
        self._above = ", ".join(context.above)
        self._period = max(pace.every for pace in context.above.values())
        slowest = max(context.every, *(pace.every for pace in context.below.values()))
        # Ticks: largest age of a usable status of the hand.
        self._oldest = slowest + self.cell.patience.ticks(slowest, context.tick_s)
        self._taken = 0  # tick at which `followed` was accepted
        self._rejected = ""  # reason for rejecting the newest command, empty if accepted
        self._held = False  # whether an operator held the loop in the last cycle
        self._met = False  # whether a status of the hand has arrived

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Report a missing `[robot.hand]` and a missing board above or below."""
        if context.robot.hand is None:
            yield "executor", cls.__name__, "it drives a hand, but there is no [robot.hand]"
        for place, boards in (("above", context.above), ("below", context.below)):
            if not boards:
                yield place, [], "it needs a board in this place"

    @abstractmethod
    def start_from(self, hand: HandStatus) -> None:
        """Start from the first `HandStatus`, or after a restart from the last messages."""

    @abstractmethod
    def follow_command(self, hand: HandStatus, tick: int) -> None:
        """Compute `self.command` from `self.followed`, and fill the loop's own status fields.

        Args:
            hand: Status with the newest sample.
            tick: Release tick of this cycle.
        """

    def process(self, tick: int) -> None:
        """Follow the newest command and fill the status."""
        hand = self.hand
        self._orders.take_commands(self.operator)
        if not self._met:
            if not hand.has_message:
                status = self.status
                status.driven = self.driven
                status.sensed = -1
                status.holding = True
                status.stopped = True
                status.reason = NO_HAND_YET
                return
            self._met = True
            self.start_from(hand.message)
        self._take_command(self.above, tick)
        hold_reason = self._find_holding_reason(tick)
        self.follow_command(hand.message, tick)
        self.command.id += 1
        self.command.operator = self._orders.find_basis(self.followed.operator)
        self._fill_status(self.status, hold_reason)
        self._orders.fill_status(self.status, self.followed.operator)

    def compute_sample_age_s(self, hand: HandStatus, tick: int) -> float:
        """Return the age of a hand sample, in s, when the command of this cycle takes effect."""
        return float(
            (min(tick - hand.tick, self._oldest) + self.context.every) * self.context.tick_s
        )

    def compute_command_age_s(self, tick: int) -> float:
        """Return the time, in s, by which the command is extrapolated.

        This is the age of the command, but at most a cycle of the level above.
        """
        return min(tick - self._taken, self._period) * self.context.tick_s

    def _take_command(self, command: Reading[RelayedCommand], tick: int) -> None:
        """Copy a new, finite command to `followed`. During a hold, zero its velocities instead."""
        released = self._held
        self._held = self._orders.is_holding
        if self._held:
            for name in self._numbers:
                # Keep following the command, but at zero velocity.
                if name.endswith("velocity"):
                    setattr(self.followed, name, 0.0)
            self._orders.report_done()
        elif command.is_new or (released and command.has_message):
            wrong = [
                name
                for name in self._numbers
                if not np.isfinite(getattr(command.message, name)).all()
            ]
            self._rejected = (
                f"rejected: {wrong[0]} commanded by '{self._above}' is not finite" if wrong else ""
            )
            if not wrong:
                self.followed.copy_from(command.message)
                self.commanded = True
                self._taken = tick

    def _find_holding_reason(self, tick: int) -> str:
        """Return why the hand does not follow the level above, or an empty string if it does."""
        hand = self.hand.message
        if self.hand.is_lost or tick - hand.tick > self._oldest:
            return HAND_LOST
        if hand.stopped:
            return f"hand: {hand.reason}"
        if "below" in self.inputs:
            below = self.below
            if below.is_lost or not below.has_message:
                return BELOW_LOST
            if below.message.stopped:
                return below.message.reason
        return self._orders.format_reason(self.context.board)

    def _fill_status(self, status: LoopStatus | FingerStatus, hold_reason: str) -> None:
        """Fill the status. `hold_reason` is empty if the hand follows the level above."""
        hand = self.hand.message
        lost = self.commanded and self.above.is_lost
        status.sensed = hand.tick
        status.echo = self.followed.id
        note = hold_reason or self._rejected
        if lost and not note:
            note = f"no command from '{self._above}': its last one is kept"
        status.driven = self.driven
        status.stopped = bool(hold_reason)
        status.holding = lost or not self.commanded
        status.reason = note
        status.error = hand.error
        if hand.error:
            status.state = State.ERROR
        elif note and self.commanded:
            status.state = State.HOLDING
        else:
            status.state = State.EXECUTING if self.commanded else State.IDLE


class FingertipLoop(HandLoop):
    """Converts postures, points and forces of fingers to joint targets. See `FingertipLaw`.

    A restarted board continues from its last targets.
    """

    above = Input(GraspTarget, "above.command")
    hand = Input(HandStatus, "hand.status")
    below = Input(LoopStatus, "below.status")
    operator = OPERATOR
    last = Input(FingerTarget, "own.command")
    command = Output(FingerTarget, rests_on=above)
    status = Output(FingerStatus)
    followed: GraspTarget
    params = FingertipGains
    settings: FingertipGains

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(self.hand_model.names), True)
        kinematics = FingerKinematics(self.cell, self.hand_model)
        self._law = FingertipLaw(
            kinematics, range(len(self.driven)), self.settings, context.period_s
        )

    def start_from(self, hand: HandStatus) -> None:
        """Start at the last targets after a restart, otherwise at the current joint positions."""
        last = self.last.message
        begin = last if self.last.has_message and last.active else hand
        self._law.start(begin.position)

    def follow_command(self, hand: HandStatus, tick: int) -> None:
        """Compute the joint targets."""
        set_finger_targets(self, self._law, hand, self.command, self.status, tick)


class JointLoop(HandLoop):
    """Moves the joints to their targets. See `JointLaw`.

    Until targets arrive it holds the joints in their initial positions.
    """

    above = Input(FingerTarget, "above.command")
    hand = Input(HandStatus, "hand.status")
    below = Input(LoopStatus, "below.status")
    operator = OPERATOR
    command = Output(TendonTorque, rests_on=above)
    status = Output(LoopStatus)
    followed: FingerTarget
    params = JointGains
    settings: JointGains
    preloads = (dynamics, laws)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(context.robot.joints), True)
        self._law = JointLaw(self.cell, self.driven, self.settings)

    def start_from(self, hand: HandStatus) -> None:
        """Hold the joints in their current positions until targets arrive."""
        self.followed.position = hand.position
        self.followed.stiff[:] = 1.0

    def follow_command(self, hand: HandStatus, tick: int) -> None:
        """Compute the torques for the newest targets."""
        self._law.set_torques(
            hand,
            self.followed,
            self.compute_sample_age_s(hand, tick),
            self.compute_command_age_s(tick),
            self.command.torque,
        )
        self.command.sampled = hand.tick
        self.status.clipped = self._law.clipped


class TendonLoop(HandLoop):
    """Commands a tension for each tendon in every cycle. See `TendonLaw`.

    Each command contains the tick of the oldest hand status on which it depends, so that the hand
    also detects the loss of the joint loop.
    """

    above = Input(TendonTorque, "above.command")
    hand = Input(HandStatus, "below.status")
    operator = OPERATOR
    command = Output(TensionCommand, rests_on=above)
    status = Output(LoopStatus)
    followed: TendonTorque
    params = TendonGains
    settings: TendonGains
    preloads = (laws,)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.driven = np.full(len(context.robot.joints), True)
        self._law = TendonLaw(self.hand_model, self.driven, self.settings, context)

    def start_from(self, hand: HandStatus) -> None:
        """Start with the current tensions."""
        self._law.start(hand)

    def follow_command(self, hand: HandStatus, tick: int) -> None:
        """Compute the tensions for the newest torques."""
        command = self.command
        command.driven = self.driven
        command.sampled = min(hand.tick, self.followed.sampled) if self.commanded else -1
        if command.sampled >= 0:
            self._law.set_tensions(hand, self.followed.torque, command.tension)
        self.status.clipped = self._law.clipped


class FingerParams(FingertipGains, JointGains, TendonGains):
    """`[board.<name>.params]` of a board that runs all loops of a finger."""

    finger: str
    """name of the finger in robot.hand.finger"""


class FingerExecutor(HandLoop):
    """Drives the tendons of one finger as commanded by the grasp loop.

    Until a command arrives, also after a restart, it holds the finger in its current position.
    """

    above = Input(GraspTarget, "above.command")
    hand = Input(HandStatus, "below.status")
    operator = OPERATOR
    command = Output(TensionCommand, rests_on=above)
    status = Output(FingerStatus)
    followed: GraspTarget
    params = FingerParams
    settings: FingerParams
    preloads = (dynamics, laws)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = self.settings
        hand = self.hand_model
        finger = hand.names.index(params.finger)
        self.driven = np.arange(len(hand.names)) == finger
        self._joints = hand.fingers[finger]
        self._tip = FingertipLaw(
            FingerKinematics(self.cell, hand), [finger], params, context.period_s
        )
        self._servo = JointLaw(self.cell, self._joints, params)
        self._tendons = TendonLaw(hand, self._joints, params, context)
        self._target = FingerTarget.zeros(context.sizes)
        self._torque = np.zeros(len(self._joints))

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Report a finger that the hand does not have, and the mistakes that `HandLoop` reports."""
        yield from super().find_mismatches(context)
        hand = context.robot.hand
        name = read_params(FingerParams, context.params).finger
        if hand is not None and name not in (names := [finger.name for finger in hand.finger]):
            yield "params.finger", name, f"the hand has no such finger; fingers: {', '.join(names)}"

    def start_from(self, hand: HandStatus) -> None:
        """Hold the joints in their current positions."""
        self._tip.start(hand.position)
        self._tendons.start(hand)
        self._target.position = hand.position
        self._target.stiff[:] = 1.0

    def follow_command(self, hand: HandStatus, tick: int) -> None:
        """Compute the tensions of the finger's tendons."""
        set_finger_targets(self, self._tip, hand, self._target, self.status, tick)
        self._servo.set_torques(
            hand, self._target, self.compute_sample_age_s(hand, tick), 0.0, self._torque
        )
        self._tendons.set_tensions(hand, self._torque, self.command.tension)
        self.command.driven = self._joints
        self.command.sampled = hand.tick


def set_finger_targets(
    loop: FingertipLoop | FingerExecutor,
    law: FingertipLaw,
    hand: HandStatus,
    target: FingerTarget,
    status: FingerStatus,
    tick: int,
) -> None:
    """Compute the joint targets of a loop and fill the status of its fingers.

    Args:
        loop: Loop that follows a `GraspTarget`.
        law: Fingertip law of the loop.
        hand: Status of the hand.
        target: Joint targets; filled.
        status: Status of the fingers; filled.
        tick: Tick of the cycle.
    """
    status.tip = law.find_tips(hand.position)
    target.active = loop.followed.active
    if loop.followed.active:
        law.set_targets(loop.followed, loop.compute_command_age_s(tick), target)
    status.position = hand.position
    status.target = law.wanted
    status.force[loop.driven] = hand.force[loop.driven]
