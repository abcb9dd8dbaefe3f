"""The world model: objects and obstacles as sensed, for all planners."""

from __future__ import annotations

import math

import numpy as np

from rack.levels.algebra import Array, apply_elementwise
from rack.levels.level import Executor, Input, LevelContext, Output
from rack.levels.messages import Scene, WorldState
from rack.levels.tables import Positive, Table


class WorldParams(Table):
    """Thresholds by which a body counts as moving or resting."""

    moved: Positive = 0.002
    """distance from its resting place beyond which a body counts as moving [m]"""
    turned: Positive = 0.02
    """angle from its resting orientation beyond which a body counts as moving [rad]"""
    slow: Positive = 0.005
    """speed below which a moving body may come to rest [m/s]"""
    resting: Positive = 0.2
    """time at low speed after which a body counts as resting [s]"""


class WorldModel(Executor):
    """Executor that tracks the bodies of the scene: poses, velocities, and a revision.

    The revision increases when a body starts or stops moving. It is the tick after the last such
    change, so that it also increases across a restart of this board. Until a restarted board
    receives a scene, it publishes its last model with the tick of the last scene.
    """

    scene = Input(Scene, "servo.scene")
    last = Input(WorldState, "own.model")
    model = Output(WorldState)
    params = WorldParams
    settings: WorldParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        bodies = context.sizes["bodies"]
        # Poses in the last scene, and poses in which bodies last rested: position in m, quaternion.
        self._last, self._rest = np.zeros((2, bodies, 7))
        self._moving = np.zeros(bodies, dtype=bool)
        self._slow_s = np.zeros(bodies)
        self._seen_tick = -1
        self._interval = 0
        self._started = False

    def process(self, tick: int) -> None:
        """Update the model from a new scene. Set all velocities to 0 if scenes are overdue."""
        model = self.model
        if not self._started:
            self._started = True
            model.copy_from(self.last.message)
        if not self.scene.is_new:
            if tick - self._seen_tick > self._interval:
                model.velocity[:] = 0.0
            return
        scene = self.scene.message
        poses = np.hstack((scene.position, scene.quaternion))
        if self._seen_tick < 0:
            self._last = poses
            self._rest[:] = poses
            model.revision = tick + 1
        else:
            self._interval = tick - self._seen_tick
            if self._update_velocity(poses, self._interval * self.context.tick_s):
                model.revision = tick + 1
        model.position = scene.position
        model.quaternion = scene.quaternion
        model.sensed = self._seen_tick = tick

    def _update_velocity(self, poses: Array, elapsed_s: float) -> bool:
        """Update the velocities from new poses.

        Args:
            poses: Poses of the bodies, (bodies, 7).
            elapsed_s: Time since the last scene, s.

        Returns:
            True if a body has started or stopped moving.
        """
        p = self.settings
        slow_turn = p.turned / p.resting * elapsed_s
        is_slow = (compute_distances(poses, self._last) / elapsed_s < p.slow) & (
            compute_angles(poses, self._last) < slow_turn
        )
        self._slow_s = np.where(is_slow, self._slow_s + elapsed_s, 0.0)
        is_away = (compute_distances(poses, self._rest) > p.moved) | (
            compute_angles(poses, self._rest) > p.turned
        )
        rests = self._moving & (self._slow_s >= p.resting)
        changes = rests | (~self._moving & is_away)
        self._rest[rests] = poses[rests]
        self._moving ^= changes
        moved = (poses[:, :3] - self._last[:, :3]) / elapsed_s
        self.model.velocity[:] = np.where(self._moving[:, None], moved, 0.0)
        self._last = poses
        return bool(changes.any())


def compute_distances(poses: Array, others: Array) -> Array:
    """Return the distance in m between each pair of corresponding poses; both are (bodies, 7)."""
    x, y, z = (poses - others)[:, :3].T
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def compute_angles(poses: Array, others: Array) -> Array:
    """Return the angle in rad between the orientations of each pair of corresponding poses.

    Both arrays are (bodies, 7). The quaternions q and -q are the same orientation.
    """
    w, x, y, z = (poses * others)[:, 3:].T
    return 2.0 * apply_elementwise(math.acos, np.minimum(np.abs(w + x + y + z), 1.0))
