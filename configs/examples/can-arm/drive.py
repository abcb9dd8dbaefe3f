"""A drive of one joint, modelled on CiA 402: state machine, watchdog, heartbeat, encoder."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic, sleep

import numpy as np
import wire
from cable import Cable, Disturbance
from mechanics import Joint, Mechanics
from wire import Control, Frame, Power

from rack.backplane.process import die_with_parent, name_process, set_priority

PRIORITY = 79
"""Below the servo level, which must not wait for drives, and above all others."""
LOOKS = 2
"""Reads of the bus per tick. If every frame woke all seven drives, they would use 1.5 cores."""
DRIFT_S = 1e-7
"""Largest drift per tick between the clocks of rack and drive."""
WINDOW_S = 5e-3
"""Largest lateness of a SYNC that the clock of a drive compensates."""
LADDER = {
    Power.SWITCH_ON_DISABLED: Control.DISABLE_VOLTAGE,
    Power.READY_TO_SWITCH_ON: Control.SHUT_DOWN,
    Power.SWITCHED_ON: Control.SWITCH_ON,
    Power.OPERATION_ENABLED: Control.ENABLE_OPERATION,
}
"""Control word that leads to each state. A drive can go down any number of states, and up by
one."""
POWERS = list(LADDER)
DEFECTS = {Disturbance.BUS_OFF: wire.BUS_OFF, Disturbance.TOO_HOT: wire.TOO_HOT}


def next_power(power: Power, control: int) -> Power:
    """Return the state of a drive after it has received a control word."""
    if power is Power.FAULT:
        return Power.SWITCH_ON_DISABLED if control == Control.RESET_FAULT else power
    reachable = POWERS[: POWERS.index(power) + 2]
    return next((reached for reached in reachable if LADDER[reached] == control), power)


class TickClock:
    """Estimates the times of the rack's ticks from SYNC frames.

    SYNC frames may be late, but are never early.
    """

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._start_s = 0.0

    def at(self, tick: int, came_s: float) -> float:
        """Estimate the time of a tick in s, given that its SYNC arrived at `came_s`."""
        start_s = came_s - tick * self._tick_s
        # Accept a very late SYNC, or one of another run: the next timely one corrects the estimate.
        if not self._start_s < start_s < self._start_s + WINDOW_S:
            self._start_s = start_s
        self._start_s += DRIFT_S
        return self._start_s + tick * self._tick_s


class Drive:
    """Processes the frames for one node, and answers them."""

    def __init__(
        self,
        node: int,
        joint: Joint,
        send: Callable[[int, bytes], None],
        times_s: tuple[float, float],
        now_s: float,
    ) -> None:
        """Boot.

        Args:
            node: Node on the bus.
            joint: The joint to drive.
            send: Sends a frame, given its kind and data.
            times_s: Length of a tick, and time without a torque after which the brake engages.
            now_s: Current time.
        """
        self.power = Power.SWITCH_ON_DISABLED
        self.fault = 0
        self._node = node
        self._joint = joint
        self._send = send
        tick_s, self._patience_s = times_s
        self._clock = TickClock(tick_s)
        self._newest = -1  # tick of the newest command
        self._driven_s = self._heard_s = self._beat_s = now_s
        joint.brake()
        send(wire.HEARTBEAT, wire.BOOTED)

    def take(self, frame: Frame) -> None:
        """Process a received frame: a SYNC, a command or a heartbeat of the rack."""
        kind, node, data, came_s = frame
        identifier = kind + node
        if identifier == wire.SYNC:
            tick = wire.read_tick(data)
            self._joint.advance(self._clock.at(tick, came_s))
            report = wire.REPORT.pack(tick, self.power, self.fault, *self._joint.sample())
            self._send(wire.STATUS, report)
        elif identifier == wire.COMMAND and wire.read_tick(data) != self._newest:
            self._newest = wire.read_tick(data)
            self._joint.advance(came_s)
            self._execute_entry(
                np.frombuffer(data, wire.ORDER, self._joint.count, wire.TICK.size), came_s
            )
        elif identifier == wire.HEARTBEAT + wire.RACK:
            self._heard_s = came_s

    def _execute_entry(self, orders: wire.Orders, came_s: float) -> None:
        """Execute this drive's entry in a command that arrived at `came_s`."""
        control = int(orders["control"][self._node - 1])
        power = next_power(self.power, control)
        if power is not self.power:
            self._change_state(power)
        if power is Power.OPERATION_ENABLED and control == Control.ENABLE_OPERATION:
            self._driven_s = came_s
            self._joint.drive(orders["torque"] * wire.UNIT)

    def watch(self, now_s: float, trouble: Disturbance) -> None:
        """Detect faults and time-outs, and send the heartbeat.

        Args:
            now_s: Current time.
            trouble: Current disturbance of the drive.
        """
        fault = DEFECTS.get(trouble, 0)
        if now_s - self._heard_s > wire.SILENT_S:
            fault = fault or wire.NO_HEARTBEAT
        if fault and self.power in (Power.SWITCHED_ON, Power.OPERATION_ENABLED):
            self._change_state(Power.FAULT, fault)
        if now_s - self._driven_s > self._patience_s:
            if self.power is Power.OPERATION_ENABLED:
                self._change_state(Power.SWITCHED_ON)
            # Leave out the last `WINDOW_S`, because a SYNC for that time may still arrive.
            self._joint.advance(now_s - WINDOW_S)
        if now_s - self._beat_s > wire.HEARTBEAT_S:
            self._beat_s = now_s
            self._send(wire.HEARTBEAT, wire.OPERATIONAL)

    def _change_state(self, power: Power, fault: int = 0) -> None:
        """Change the state and the fault, and brake unless the new state permits torque."""
        self.power = power
        self.fault = fault
        if power is not Power.OPERATION_ENABLED:
            self._joint.brake()


def run_drive(node: int, mechanics: Mechanics, times_s: tuple[float, float], parent: int) -> None:
    """Run a drive in this process until it is reset or the parent process ends.

    Args:
        node: Node of the drive on the bus.
        mechanics: Mechanics of the arm, in shared memory.
        times_s: As in `Drive`.
        parent: Process id of the parent.
    """
    die_with_parent(parent)
    name_process(f"drive {node}")
    set_priority(PRIORITY)
    with wire.open_bus() as bus:
        cable = Cable(bus, node)
        drive = Drive(node, Joint(mechanics, node - 1), cable.send, times_s, monotonic())
        while cable.disturbance is not Disturbance.RESET:
            cable.receive(drive.take)
            drive.watch(monotonic(), cable.disturbance)
            sleep(times_s[0] / LOOKS)
