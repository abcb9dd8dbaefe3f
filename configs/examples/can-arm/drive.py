"""A drive of one joint, after CiA 402: state machine, watchdog, heartbeat, encoder."""

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
"""Below that of the servo level, which must not wait for drives; above all others'."""
LOOKS = 2
"""At the bus, in a tick. Woken by every frame, seven drives would take a core and a half."""
DRIFT_S = 1e-7
"""By how much the rack's clock may come later in a tick, as a drive's own clock sees it."""
WINDOW_S = 5e-3
"""Largest lateness of a SYNC that a drive's clock sees through."""
LADDER = {
    Power.SWITCH_ON_DISABLED: Control.DISABLE_VOLTAGE,
    Power.READY_TO_SWITCH_ON: Control.SHUT_DOWN,
    Power.SWITCHED_ON: Control.SWITCH_ON,
    Power.OPERATION_ENABLED: Control.ENABLE_OPERATION,
}
"""States, and the control words that lead to them: down by any number of steps, up by one."""
POWERS = list(LADDER)
DEFECTS = {Disturbance.BUS_OFF: wire.BUS_OFF, Disturbance.TOO_HOT: wire.TOO_HOT}


def next_power(power: Power, control: int) -> Power:
    """Return the state to which a control word takes a drive."""
    if power is Power.FAULT:
        return Power.SWITCH_ON_DISABLED if control == Control.RESET_FAULT else power
    reachable = POWERS[: POWERS.index(power) + 2]
    return next((reached for reached in reachable if LADDER[reached] == control), power)


class TickClock:
    """The times of the rack's ticks, by its SYNCs: none comes early, but any may come late."""

    def __init__(self, tick_s: float) -> None:
        self._tick_s = tick_s
        self._start_s = 0.0

    def at(self, tick: int, came_s: float) -> float:
        """Return the time, s, of a tick whose SYNC came at `came_s`."""
        start_s = came_s - tick * self._tick_s
        # A very late one, or one of another run, is believed; the next on time corrects it.
        if not self._start_s < start_s < self._start_s + WINDOW_S:
            self._start_s = start_s
        self._start_s += DRIFT_S
        return self._start_s + tick * self._tick_s


class Drive:
    """Obeys and answers the frames for its node."""

    def __init__(
        self,
        node: int,
        joint: Joint,
        send: Callable[[int, bytes], None],
        times_s: tuple[float, float],
        now_s: float,
    ) -> None:
        """Boot at `now_s`, s. `times_s`: the tick, and after which time without a torque the brake
        engages."""
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
        """Take a frame."""
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
            self._obey(np.frombuffer(data, wire.ORDER, self._joint.count, wire.TICK.size), came_s)
        elif identifier == wire.HEARTBEAT + wire.RACK:
            self._heard_s = came_s

    def _obey(self, orders: wire.Orders, came_s: float) -> None:
        control = int(orders["control"][self._node - 1])
        power = next_power(self.power, control)
        if power is not self.power:
            self._turn(power)
        if power is Power.OPERATION_ENABLED and control == Control.ENABLE_OPERATION:
            self._driven_s = came_s
            self._joint.drive(orders["torque"] * wire.UNIT)

    def watch(self, now_s: float, trouble: Disturbance) -> None:
        """Look after itself at `now_s`, s."""
        fault = DEFECTS.get(trouble, 0)
        if now_s - self._heard_s > wire.SILENT_S:
            fault = fault or wire.NO_HEARTBEAT
        if fault and self.power in (Power.SWITCHED_ON, Power.OPERATION_ENABLED):
            self._turn(Power.FAULT, fault)
        if now_s - self._driven_s > self._patience_s:
            if self.power is Power.OPERATION_ENABLED:
                self._turn(Power.SWITCHED_ON)
            # Not to now: the SYNC of an earlier time may still come.
            self._joint.advance(now_s - WINDOW_S)
        if now_s - self._beat_s > wire.HEARTBEAT_S:
            self._beat_s = now_s
            self._send(wire.HEARTBEAT, wire.OPERATIONAL)

    def _turn(self, power: Power, fault: int = 0) -> None:
        self.power = power
        self.fault = fault
        if power is not Power.OPERATION_ENABLED:
            self._joint.brake()


def run_drive(node: int, mechanics: Mechanics, times_s: tuple[float, float], parent: int) -> None:
    """Run a drive in a process of its own, until it is reset or its parent ends."""
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
