"""A servo level alone, under the set points of a test."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults import KINDS
from rack.levels.algebra import Array
from rack.levels.level import Fault, Finding
from rack.levels.messages import JointCommand
from rack.levels.servo import ServoExecutor, ServoLaw, ServoPlanner
from rack.levels.tables import RobotConfig, SceneConfig
from tests.levels.arms import config
from tests.levels.lockstep import CLOCK_NS, BoardSpec, Lockstep

TICK_S = CLOCK_NS * 1e-9
PERIOD = 8
"""Ticks between set points: 50 Hz."""
BRAKES = (Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED)


class Course(NamedTuple):
    """A minimum-jerk motion between two positions, (joints,), rad, that starts at second 0."""

    start: Array
    goal: Array
    duration_s: float

    def at(self, time_s: float) -> tuple[Array, Array]:
        u = min(max(time_s / self.duration_s, 0.0), 1.0)
        way = self.goal - self.start
        velocity = way * 30 * u * u * (1 - u) ** 2 / self.duration_s
        return self.start + way * u**3 * (10 - 15 * u + 6 * u * u), velocity


class Found(NamedTuple):
    """A finding and the tick of the cycle that found it."""

    tick: int
    finding: Finding


class ArmRig:
    """Runs a rack tick by tick, and keeps what the board that drives the arm finds."""

    board = "servo"

    def __init__(self, rack: Lockstep) -> None:
        self.rack = rack
        self.targets: list[Array] = []
        self.positions: list[Array] = []
        self.found: list[Found] = []
        self.acted: list[int] = []
        self._faults: list[Fault] = []

    @property
    def level(self) -> Any:
        """Present executor, which a restart replaces."""
        return self.rack.tasks[self.board].level

    @property
    def status(self) -> Message:
        """Last status of the executor."""
        return cast(Message, self.rack.tasks[self.board].written["status"])

    def step(self) -> None:
        """Run one tick as a board does: collect the findings, and the faults that acted."""
        level = self.level
        self.rack.step()
        self.found += [Found(self.rack.tick - 1, finding) for finding in level.findings]
        self.acted += [self.rack.tick - 1] * any(level.acted.values())
        level.findings.clear()
        level.acted.clear()

    def inject(self, kind: str, seed: int = 5, **parameters: float) -> int:
        """Begin another fault in the next tick; return that tick."""
        self._faults.append(Fault(kind, parameters, seed, self.rack.tick, KINDS[kind].step))
        self.level.inject(self._faults)
        return self.rack.tick

    def heal(self) -> None:
        """End all faults from the next tick on."""
        self._faults = []
        self.level.inject([])

    def alarms(self, *but: Alarm) -> list[Alarm]:
        """Return the alarms that were raised, in order, except `but`."""
        return [finding.alarm for _, finding in self.found if finding.alarm not in but]


class ServoRig(ArmRig):
    """Runs executor and planner of the servo level, with set points that are a function of time."""

    executor: type[ServoLaw] = ServoExecutor
    outside: Mapping[str, type[Message]] = {"primitive.command": JointCommand}
    """Mailboxes that the test writes."""

    def __init__(self, robot: RobotConfig, scene: SceneConfig, name: str = "", **law: Any) -> None:
        places = {"above": "primitive", "params": law}
        board = BoardSpec("servo", 1, self.executor, ServoPlanner, PERIOD, **places)
        super().__init__(Lockstep([board], robot, scene, outside=self.outside, name=name))
        self.command: Message = self.rack.message("primitive.command")
        self.command.opening, self.command.force, self.command.held = 0.04, 20.0, -1

    @property
    def servo(self) -> ServoExecutor:
        return cast(ServoExecutor, self.level)

    @property
    def state(self) -> Message:
        """Last state of the arm that the executor wrote."""
        return cast(Message, self.rack.tasks["servo"].written["state"])

    def set_point(self, position: Array, velocity: Array, due: int) -> None:
        self.command.id += 1
        self.command.position, self.command.velocity, self.command.due = position, velocity, due
        self.rack.write("primitive.command", self.command)

    def run(self, ticks: int, motion: Callable[[float], tuple[Array, Array]] | None = None) -> None:
        """Run `ticks` ticks. Set points of `motion` come every `PERIOD` ticks, a period ahead."""
        for _ in range(ticks):
            if motion is not None and self.rack.tick % PERIOD == 0:
                due = self.rack.tick + PERIOD
                self.set_point(*motion(due * TICK_S), due)
            self.step()
            self.targets.append(self.status.target.copy())
            self.positions.append(self.status.position.copy())

    def torques(self, ticks: int, motion: Callable[[float], tuple[Array, Array]]) -> Array:
        """Run `ticks` ticks; return the torque of each, (ticks, joints), N m."""
        found = []
        for _ in range(ticks):
            self.run(1, motion)
            found.append(self.status.torque.copy())
        return np.array(found)

    def restart(self) -> None:
        """Replace the executor by a new one, with the same faults."""
        self.rack.restart("servo")
        self.servo.inject(self._faults)

    def miss(self, ticks: int) -> None:
        self.rack.tasks["servo"].due += ticks

    def errors(self, motion: Callable[[float], tuple[Array, Array]]) -> Array:
        """Return the tracking error for `motion` at each tick, (ticks, joints), rad."""
        wanted = [motion(tick * TICK_S)[0] for tick in range(len(self.positions))]
        return np.array(self.positions) - np.array(wanted)


HOME = np.array(config("puma560")[0].home)
GOAL = np.array([0.6, 1.0, -2.6, 0.4, -1.2, 0.5])
MOVE = Course(HOME, GOAL, 2.0)
"""A motion of the PUMA."""


def rig_under_way(**params: Any) -> ServoRig:
    """Return the PUMA in the middle of `MOVE`."""
    rig = ServoRig(*config("puma560"), **params)
    rig.run(400, MOVE.at)
    return rig
