"""A level above boards that servo joints: it moves every joint smoothly to and fro."""

from __future__ import annotations

import math

import numpy as np

from rack.backplane.message import State
from rack.levels.joint_messages import JOINT_REFERENCE, JOINT_STATUS
from rack.levels.level import Executor, Input, LevelContext, Ports
from rack.levels.messages import PRIMITIVE_STATUS
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics

AWAY_RAD = 0.15
"""How far every joint moves away from home."""
PERIOD_S = 1.2
"""Time to move away and back."""


class Swing(Executor):
    """Moves all joints away from home and back, while no board below says that it is stopped; else it stays there."""

    inputs = {"statuses": Input(JOINT_STATUS, "below.status", many=True)}
    outputs = {"command": JOINT_REFERENCE, "status": PRIMITIVE_STATUS}

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self._home, self._dynamics = cell.home, Dynamics(cell)
        self._begun: int | None = None  # tick at which the present motion began
        self._from = cell.home.copy()

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Write the set point due two cycles later."""
        command, status, due = write.command, write.status, tick + 2 * self.context.every
        statuses = [reading.value for reading in read.statuses.values() if reading.is_there]
        held = len(statuses) < len(read.statuses) or any(one.stopped for one in statuses)
        held = held or any(reading.is_lost for reading in read.statuses.values())
        status.state = State.HOLDING if held else State.EXECUTING
        status.reason = "a board below has stopped" if held else ""
        if held:
            self._begun, command.due = None, 0
            return
        if self._begun is None:
            self._begun, self._from = due, statuses[0].position.copy()
        phase = 2.0 * math.pi * (due - self._begun) * self.context.tick_s / PERIOD_S
        rate = 2.0 * math.pi / PERIOD_S
        command.id += 1
        command.due = due
        command.position = self._from + AWAY_RAD * 0.5 * (1.0 - math.cos(phase))
        command.velocity = np.full(len(self._home), AWAY_RAD * 0.5 * rate * math.sin(phase))
        command.acceleration = np.full(len(self._home), AWAY_RAD * 0.5 * rate**2 * math.cos(phase))
        inertia, bias = self._dynamics.terms(command.position, command.velocity)
        command.inertia, command.load = np.diagonal(inertia), bias
        command.opening, command.force = 0.04, 20.0
