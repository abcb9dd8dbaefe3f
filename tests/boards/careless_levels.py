"""Levels that drive an arm without a status, findings or a state of the arm."""

from __future__ import annotations

import numpy as np

from rack.levels.arm import SimulatedArm
from rack.levels.level import Executor, LevelContext, Output
from rack.levels.messages import ArmState
from rack.levels.robot.cell import build_cell
from rack.levels.tables import Table, read_params


class CarelessParams(Table):
    """What the level does wrong."""

    torques: tuple[float, ...] = ()
    """torque of j3 in the cycles from tick `first` on, one each [N m]; any other holds it"""
    first: int = 50
    thrown: bool = False
    """at tick 50, the arm is faster than its limits"""
    saves: bool = True
    """it saves the state of the arm by itself"""


class Careless(Executor):
    """Holds the arm where it is, but for what its parameters say."""

    state = Output(ArmState)
    params = CarelessParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = read_params(CarelessParams, context.params)
        cell = build_cell(context.robot, context.scene, context.clock_ns)
        self._arm = SimulatedArm(cell, context.scene, context.clock_ns, context.every, context.seed)

    def process(self, tick: int) -> None:
        arm = self._arm
        if self._params.thrown and tick == 50:
            arm._data.qvel[arm.cell.dof[1]] = 3.0
        arm.step(tick - arm.tick)
        sensed = arm.sense()
        inertia, bias = arm.dynamics.terms(sensed.position, sensed.velocity)
        slip = 400.0 * (arm.cell.home - sensed.position) - 40.0 * sensed.velocity
        limit = arm.cell.bounds.torque
        torque = np.clip(bias + inertia.diagonal() * slip, -limit, limit)
        given = dict(enumerate(self._params.torques, self._params.first))
        torque[2] = given.get(tick, torque[2])
        arm.drive(torque, 0.0)
        if self._params.saves:
            arm.save(self.state)
