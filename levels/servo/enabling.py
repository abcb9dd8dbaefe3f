"""Enables an arm at the start or by an operator's command, and takes over its pose."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from rack.levels.arm import DriveState, Sensed
from rack.levels.level import LevelContext, Reading
from rack.levels.messages import ArmState
from rack.levels.operator import Operation, OperatorCommand
from rack.levels.servo.sensor_monitor import SensorMonitor
from rack.levels.servo.stopping import Stopping

if TYPE_CHECKING:
    from rack.levels.arm import Arm


class Enabling:
    """Tracks whether the drives of an arm are enabled. Only an enabled arm is driven and checked.

    Whoever enables an arm must be able to see it. An operator must therefore enable it again after
    a fault, or after the drives have switched off by themselves. A restart of the board does not
    change the state of the drives.

    An arm that is not enabled may be moved by hand, and its drives may give no samples. Samples are
    therefore compared with earlier ones only after the arm was enabled and its pose adopted.

    Attributes:
        is_started: True once the first cycle has begun.
        is_taken_over: True if the arm is enabled, and its pose was adopted since.
    """

    def __init__(
        self,
        arm: Arm,
        sensors: SensorMonitor,
        stopping: Stopping,
        context: LevelContext,
    ) -> None:
        robot = context.robot
        self._arm = arm
        self._sensors = sensors
        self._stopping = stopping
        self.is_started = self.is_taken_over = False
        self._at_start = robot.enable == "at-start" or (robot.enable is None and arm.keeps_limits)
        self._command = f"rack command {context.rack} {context.board}"
        self.slow = (
            f"{robot.bring_up or 1.0:.0%} of full speed; to end that: {self._command} release"
        )
        self._guessed = "" if arm.keeps_limits else ", ".join(robot.guessed)
        self._restarted = False  # first cycle after a restart, in which old commands are read again
        self._serial = 0  # serial of the newest command while the drives carry it out, else 0
        # The last enable or disable command of a cycle, old ones included, is `disable`.
        self._disables = False
        self._leaves = False  # an operator has disabled the arm, which its drives may not show yet
        self._goal: Collection[DriveState] = ()  # states in which the command is done

    def start(self, before: Reading[ArmState]) -> bool:
        """Take over the arm in the first cycle. Return True if it was restored after a restart.

        The arm is enabled, unless an operator must enable it or the board was restarted.
        """
        self.is_started = True
        self._restarted = before.has_message
        if self._restarted:
            self.restore_arm(before.message)
            self.is_taken_over = self.is_enabled
        elif self._at_start and not self._guessed:
            self._arm.enable()
        return self._restarted

    def restore_arm(self, state: ArmState) -> None:
        """Let arm, sensors and stopping continue from a state."""
        self._arm.restore(state)
        self._sensors.restore_estimate(state)
        self._stopping.restore_state(state)

    def adopt_pose(self, sensed: Sensed, tick: int) -> bool:
        """Adopt the sensed pose unless the arm is taken over.

        Returns:
            True if the sample of this cycle can be checked: either the arm is enabled, or its pose
            was just adopted.
        """
        is_enabled = self.is_enabled
        if self.is_taken_over and is_enabled:
            return True
        is_adopted = self._sensors.adopt_pose(sensed, tick)
        self.is_taken_over = is_adopted and is_enabled
        return is_adopted or is_enabled

    def obey_command(self, command: OperatorCommand) -> str:
        """Carry out one of `rack.levels.operator.DRIVE_OPERATIONS`.

        Returns:
            Reason for the refusal, or an empty string.
        """
        arm = self._arm
        goal: Collection[DriveState] = list(DriveState)
        if command.what in (Operation.ENABLE, Operation.DISABLE):
            self._disables = command.what == Operation.DISABLE
        if command.what == Operation.ENABLE and not self.is_enabled:
            if self._restarted:
                return "its board was restarted since; if it still stands, command it again"
            if self._guessed or arm.state is DriveState.FAULT:
                return self.reason
            goal = (DriveState.ENABLED,)
            self._leaves = False
            arm.enable()
        elif command.what == Operation.DISABLE:
            goal = (DriveState.DISABLED, DriveState.FAULT)
        elif command.what == Operation.RESET and arm.state is DriveState.FAULT:
            if not self._restarted:
                arm.reset()
            goal = set(DriveState) - {DriveState.FAULT}
        self._serial = command.id
        self._goal = goal
        return ""

    def pop_finished_command(self) -> int:
        """Return the serial of a command that the drives have just carried out, else 0.

        Call this once per cycle, after `obey_command`, because a `disable` takes effect only in
        this call.
        """
        self._restarted = False
        if self._disables:
            self._disables = False
            self._leaves = True
            self._arm.disable()
        if not self._serial or self._arm.state not in self._goal:
            return 0
        serial = self._serial
        self._serial = 0
        return serial

    @property
    def is_enabled(self) -> bool:
        """True if the arm may be driven."""
        return self._arm.state is DriveState.ENABLED and not self._leaves

    @property
    def reason(self) -> str:
        """Why the arm is not enabled, and how to enable it."""
        state = self._arm.state
        if state is DriveState.FAULT:
            return f"drives: {self._arm.fault}; to go on: `reset`, then `enable`"
        if state is DriveState.ENABLING:
            return "drives are being enabled"
        if self._guessed:
            return f"confirm, then remove from robot.guessed, before it is enabled: {self._guessed}"
        return f"disabled; to enable: {self._command} enable"
