"""A servo level, and the drives of `can-arm` on a bus within this process, in simulated time."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.robot.cell import build_cell
from rack.levels.tables import SceneConfig
from tests.levels.arms import pendulum
from tests.levels.lockstep import CLOCK_NS, Operator
from tests.levels.servo.rig import TICK_S, ServoRig

EXAMPLE = Path(__file__).parents[2] / "configs" / "examples" / "can-arm"
PATIENCE_TICKS = 4
POLLS = 3
"""Looks of a drive at the bus, a tick."""
START, GOAL = np.array([0.0, 0.5]), np.array([0.6, -0.4])


class Simulated(NamedTuple):
    """A drive in simulated time."""

    cable: Any
    drive: Any


class DrivenRig(ServoRig):
    """A servo level, and the drives of its arm on a bus within this process, all in simulated
    time."""

    def __init__(self, example: Any, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(example.cable, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(example.cable, "time", lambda: self.now_s)
        clock = SimpleNamespace(time=lambda: self.now_s)
        monkeypatch.setattr("can.interfaces.virtual.time", clock)
        sensors = {"resolution": 2e-5, "noise": 1e-5}
        config = pendulum(folder, latency_ticks=3, patience_ms=10.0, sensors=sensors)
        self.cell = build_cell(config, SceneConfig(), CLOCK_NS)
        self.example = example
        self.mechanics = example.mechanics.Mechanics(self.cell, self.now_s)
        super().__init__(config, SceneConfig(), "own", arm="can_arm:CanArm")
        self.operator = Operator(self.rack)
        self.drives = [self.booted(1), self.booted(2)]

    def booted(self, node: int) -> Simulated:
        """Return a drive that has just booted."""
        cable = self.example.cable.Cable(self.example.wire.open_bus(), node)
        joint = self.example.mechanics.Joint(self.mechanics, node - 1)
        times_s = TICK_S, PATIENCE_TICKS * TICK_S
        return Simulated(
            cable, self.example.drive.Drive(node, joint, cable.send, times_s, self.now_s)
        )

    def step(self) -> None:
        super().step()
        for _ in range(POLLS):
            self.now_s += TICK_S / POLLS
            for cable, drive in self.drives:
                cable.receive(drive.take)
                drive.watch(self.now_s, cable.disturbance)

    @property
    def arm(self) -> Any:
        """The rack's side."""
        return self.servo.arm

    @property
    def powers(self) -> list[str]:
        """States of the drives."""
        return [drive.power.name for _, drive in self.drives]

    @property
    def age(self) -> int:
        """Of the newest sample, ticks."""
        return int(self.arm.tick - self.arm.sense().tick)

    def send(self, kind: int, node: int, data: bytes) -> None:
        """Send a frame from elsewhere."""
        with self.example.wire.open_bus() as bus:
            self.example.wire.send(bus, kind, node, data)

    def disturb(self, kind: str, seconds: float, size: float = 0.0) -> int:
        """Disturb the second drive from the next tick on; return that tick."""
        wire = self.example.wire
        data = wire.SPAN.pack(self.example.cable.Disturbance[kind], seconds, size)
        self.send(wire.DISTURB, 2, data)
        self.found.clear()
        return self.rack.tick

    def swing(self, ticks: int) -> list[int]:
        """Run with set points that do not come to rest; return the age of the newest sample at
        each tick."""
        ages = []
        for _ in range(ticks):
            self.run(1, to_and_fro)
            ages.append(self.age)
        return ages

    def after(self, tick: int) -> list[tuple[int, Alarm]]:
        """Return what was found, and how many ticks after `tick`, but for what adds nothing."""
        return [
            (found.tick - tick, found.finding.alarm)
            for found in self.found
            if found.finding.alarm is not Alarm.RE_REFERENCED
        ]


def to_and_fro(time_s: float) -> tuple[Array, Array]:
    """A motion that does not end."""
    way = 0.5 * (GOAL - START)
    return START + way * (1 - np.cos(2.0 * time_s)), way * 2.0 * np.sin(2.0 * time_s)
