"""An arm with drives on a CAN bus: the rack's side of the bus."""

from __future__ import annotations

import numpy as np
import wire
from wire import Control, Power, Report

from rack.levels.algebra import Array
from rack.levels.arm import Arm, DriveState, Sensed
from rack.levels.errors import LevelError
from rack.levels.level import Finding
from rack.levels.messages import ArmState
from rack.levels.robot.cell import Cell
from rack.levels.tables import SceneConfig

INCOMPLETE = 20
"""Maximum number of ticks whose incomplete reports are kept."""
ANSWER_S = 5.0
"""Time within which drives must answer an enable request; they may still be booting."""
ON = (Power.SWITCHED_ON, Power.OPERATION_ENABLED)
UP: dict[int, Control] = {
    Power.SWITCH_ON_DISABLED: Control.SHUT_DOWN,
    **dict.fromkeys((Power.READY_TO_SWITCH_ON, *ON), Control.SWITCH_ON),
}
"""Control words that move a drive towards SWITCHED_ON, keyed by state. The brake stays engaged."""


class CanArm(Arm):
    """Sends a SYNC and a command in every cycle, and reads the reports that have arrived.

    No method blocks. A sample is complete when all drives have answered the same SYNC. The arm is
    enabled while all drives are switched on. If a drive leaves this state, reports a fault or stops
    sending, the arm has a fault, and all other drives are switched off.
    """

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        self._rate_hz = 1e9 / clock_ns
        self._joints = len(cell.home)
        if self._joints > wire.MOST_DRIVES:
            raise LevelError(f"{self._joints} joints; a command has room for {wire.MOST_DRIVES}")
        self._sample = Sensed(cell.home.copy(), np.zeros(self._joints), 0.0, 0.0, -1)
        self._coming: dict[int, dict[int, Report]] = {}  # by tick and joint
        self._newest: dict[int, Report] = {}  # by joint
        self._heard = [0.0] * self._joints  # tick of the newest frame of each drive
        self._beat = 0.0  # tick of the next heartbeat
        self._reset_until = 0.0  # tick
        self._wanted = False  # whether the drives are to be enabled
        self._bus = wire.open_bus()

    def sense(self) -> Sensed:
        """Return the newest sample."""
        return self._sample

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Command torques, or brake if one of them is NaN or beyond its limit."""
        finding = self.refused(torque)
        if finding is not None:
            self.brake()
            return finding
        self.torque = torque.copy()
        self.waited = 0
        self.braked = False
        self._send_command([Control.ENABLE_OPERATION] * self._joints)
        return None

    def brake(self) -> None:
        """Engage the brakes."""
        self.torque = np.zeros(self._joints)
        self.braked = True
        self._send_command([self._next_control(joint) for joint in range(self._joints)])

    def step(self, ticks: int) -> None:
        """Advance the time: read frames that have arrived, and request the next sample."""
        self.tick += ticks
        self.waited += ticks
        self.braked = self.braked or self.waited >= self.patience
        for frame in wire.receive(self._bus):
            if 0 < frame.node <= self._joints:
                self._take_frame(frame.node - 1, frame)
        self._update_state()
        wire.send(self._bus, wire.SYNC, 0, wire.TICK.pack(self.tick))
        if self.tick >= self._beat:
            self._beat = self.tick + wire.HEARTBEAT_S * self._rate_hz
            wire.send(self._bus, wire.HEARTBEAT, wire.RACK, wire.OPERATIONAL)

    def enable(self) -> None:
        """Ask the drives to get ready for torque."""
        self._request_power()
        self.state = DriveState.ENABLING

    def disable(self) -> None:
        """Switch the drives off."""
        self._wanted = False
        self.state = DriveState.DISABLED
        self.brake()

    def reset(self) -> None:
        """Clear the fault of the arm and its drives. The arm is disabled afterwards."""
        if self.state is DriveState.FAULT:
            self.fault = ""
            self.state = DriveState.DISABLED
            self._reset_until = self.tick + wire.SILENT_S * self._rate_hz

    def restore(self, state: ArmState) -> None:
        """Continue after a restart of the board. Enable the drives again unless they were disabled.

        During the restart the drives kept their states, or their watchdogs engaged the brakes.
        """
        super().restore(state)
        if self.state is not DriveState.DISABLED:
            self._request_power()

    def _request_power(self) -> None:
        """Request that the drives be enabled, and allow extra time for their first answers."""
        self._wanted = True
        # Discard old reports of drives that no longer answer.
        self._newest.clear()
        self._heard = [self.tick + ANSWER_S * self._rate_hz] * self._joints

    def _send_command(self, control: list[Control]) -> None:
        """Send the torques, with a control word for each drive."""
        wire.send(self._bus, wire.COMMAND, 0, wire.command(self.tick, control, self.torque))

    def _next_control(self, joint: int) -> Control:
        """Return the control word that moves a braked drive towards the requested state."""
        if self._wanted and joint not in self._newest:
            # The drive may still be on after a restart. SWITCH_ON then only removes its torque.
            return Control.SWITCH_ON
        power = self._newest[joint].power if joint in self._newest else Power.FAULT
        if power == Power.FAULT and self.tick < self._reset_until:
            return Control.RESET_FAULT
        return UP.get(power, Control.DISABLE_VOLTAGE) if self._wanted else Control.DISABLE_VOLTAGE

    def _take_frame(self, joint: int, frame: wire.Frame) -> None:
        """Process a frame from the drive of a joint.

        The sample is updated once the reports of all drives for the same tick have arrived.
        """
        self._heard[joint] = self.tick
        if frame.kind != wire.STATUS:
            return
        report = Report(*wire.REPORT.unpack_from(frame.data))
        # Ignore late reports, and reports of another run, whose ticks may be in the future.
        if not self._sample.tick < report.tick <= self.tick:
            return
        self._newest[joint] = report
        reports = self._coming.setdefault(report.tick, {})
        reports[joint] = report
        if len(reports) == self._joints:
            table = wire.UNIT * np.array([reports[j][-2:] for j in range(self._joints)]).T
            self._sample = Sensed(table[0].copy(), table[1].copy(), 0.0, 0.0, report.tick)
            self._coming = {tick: r for tick, r in self._coming.items() if tick > report.tick}
        elif len(self._coming) > INCOMPLETE:
            del self._coming[min(self._coming)]

    def _update_state(self) -> None:
        """Set `state` and `fault` from the reports of the drives."""
        on = sum(report.power in ON for report in self._newest.values())
        if fault := self._find_fault():
            self.fault = self.fault or fault
            self.state = DriveState.FAULT
            self._wanted = False
        elif self._wanted and on == self._joints:
            self.state = DriveState.ENABLED

    def _find_fault(self) -> str:
        """Return the fault of the first faulty drive as text. Empty if there is none."""
        silent = self.tick - wire.SILENT_S * self._rate_hz
        for joint, heard in enumerate(self._heard):
            if self._wanted and heard < silent:
                return f"drive {joint + 1}: no heartbeat"
        for joint, report in self._newest.items():
            if report.power == Power.FAULT and self.tick >= self._reset_until:
                why = wire.FAULTS.get(report.fault, "unknown fault")
                return f"drive {joint + 1}: {why} ({report.fault:#x})"
            if self.state is DriveState.ENABLED and report.power not in ON:
                return f"drive {joint + 1}: has lost its power"
        return ""
