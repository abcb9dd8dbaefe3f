"""The world model: global memory of objects and obstacles, updated from sensing, read by every planner."""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from rack.backplane.message import Message
from rack.levels.algebra import Array, each
from rack.levels.level import Executor, Input, LevelContext, Ports
from rack.levels.messages import SCENE, WORLD_MODEL
from rack.levels.tables import Positive, Table, read_params


class WorldParams(Table):
    """When a body counts as moving."""

    moved: Positive = Field(0.002, description="distance from where it rested at which a body moves, m")
    turned: Positive = Field(0.02, description="angle from how it rested at which a body moves, rad")
    slow: Positive = Field(0.005, description="speed below which a moving body may be resting, m/s")
    resting: Positive = Field(0.2, description="time of being slow after which it rests, s")


class WorldModel(Executor):
    """Follows the bodies of the scene: poses, velocities, and a revision that rises when a body starts or stops moving.

    The revision is the tick after the last such change, so it also rises across a restart of this board. Until it
    receives a scene, a restarted board publishes its last model, with its age.
    """

    inputs = {"scene": Input(SCENE, "servo.scene"), "last": Input(WORLD_MODEL, "own.model")}
    outputs = {"model": WORLD_MODEL}
    params = WorldParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = read_params(WorldParams, context.params)
        bodies = context.sizes["bodies"]
        self._position, self._quaternion = np.zeros((bodies, 3)), np.zeros((bodies, 4))
        self._rest_position, self._rest_quaternion = np.zeros((bodies, 3)), np.zeros((bodies, 4))
        self._moving = np.zeros(bodies, dtype=bool)
        self._slow_s = np.zeros(bodies)
        self._seen_tick = -1
        self._started = False

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Update from a new scene; without one, keep poses and set velocities to zero."""
        if not self._started:
            self._started = True
            write.model.copy_from(read.last.value)
        if not read.scene.is_new:
            write.model.velocity[:] = 0.0
            return
        scene: Message = read.scene.value
        if self._seen_tick < 0:
            self._rest_position[:], self._rest_quaternion[:] = scene.position, scene.quaternion
            write.model.revision = tick + 1
        else:
            elapsed_s = (tick - self._seen_tick) * self.context.tick_s
            self._follow(scene, write.model, elapsed_s, tick)
        self._position[:], self._quaternion[:] = scene.position, scene.quaternion
        write.model.position, write.model.quaternion = scene.position, scene.quaternion
        write.model.sensed = self._seen_tick = tick

    def _follow(self, scene: Message, model: Message, elapsed_s: float, tick: int) -> None:
        """Estimate velocities, and find the bodies that start or stop moving."""
        params = self._params
        velocity = (scene.position - self._position) / elapsed_s
        slow = np.linalg.norm(velocity, axis=1) < params.slow
        slow &= turn(self._quaternion, scene.quaternion) < params.turned * elapsed_s / params.resting
        self._slow_s[:] = np.where(slow, self._slow_s + elapsed_s, 0.0)
        away = np.linalg.norm(scene.position - self._rest_position, axis=1) > params.moved
        away |= turn(self._rest_quaternion, scene.quaternion) > params.turned
        stops = self._moving & (self._slow_s >= params.resting)
        starts = ~self._moving & away
        self._rest_position[stops], self._rest_quaternion[stops] = scene.position[stops], scene.quaternion[stops]
        self._moving ^= stops | starts
        model.velocity = np.where(self._moving[:, None], velocity, 0.0)
        if stops.any() or starts.any():
            model.revision = tick + 1


def turn(first: Array, second: Array) -> Array:
    """Return the angles (n,), rad, between orientations (n, 4); q and -q are the same orientation."""
    return np.asarray(2.0 * each(math.acos, np.clip(np.abs(np.sum(first * second, axis=1)), 0.0, 1.0)))
