"""The world model: global memory of objects and obstacles, updated from sensing, read by every
planner."""

from __future__ import annotations

import math

import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array, Mask
from rack.levels.compiled import compiled, compiled_for
from rack.levels.level import Executor, Input, LevelContext, Ports
from rack.levels.messages import SCENE, WORLD_MODEL
from rack.levels.tables import Positive, Table, read_params


class WorldParams(Table):
    """When a body counts as moving."""

    moved: Positive = 0.002
    """distance from where it rested at which a body moves, m"""
    turned: Positive = 0.02
    """angle from how it rested at which a body moves, rad"""
    slow: Positive = 0.005
    """speed below which a moving body may be resting, m/s"""
    resting: Positive = 0.2
    """time of being slow after which it rests, s"""


class WorldModel(Executor):
    """Follows the bodies of the scene: poses, velocities, and a revision that rises when a body
    starts or stops moving.

    The revision is the tick after the last such change, so it also rises across a restart of this
    board. Until it receives a scene, a restarted board publishes its last model, with its age.
    """

    inputs = {"scene": Input(SCENE, "servo.scene"), "last": Input(WORLD_MODEL, "own.model")}
    outputs = {"model": WORLD_MODEL}
    params = WorldParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = read_params(WorldParams, context.params)
        bodies = context.sizes["bodies"]
        self._last, self._rest = np.zeros(
            (2, bodies, 7)
        )  # poses in the last scene, and in which bodies rested: m, 1
        self._moving = np.zeros(bodies, dtype=bool)
        self._slow_s = np.zeros(bodies)
        self._find = find_motion.load()
        self._seen_tick = -1
        self._interval = 0
        self._started = False

    @classmethod
    def preload(cls) -> None:
        """Load the compiled function."""
        find_motion.preload()

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Update from a new scene; when one is missing, keep poses and set velocities to zero."""
        model: Message = write.model
        if not self._started:
            self._started = True
            model.copy_from(read.last.value)
        if not read.scene.is_new:
            if tick - self._seen_tick > self._interval:
                model.velocity[:] = 0.0
            return
        scene: Message = read.scene.value
        if self._seen_tick < 0:
            self._last[:, :3] = scene.position
            self._last[:, 3:] = scene.quaternion
            self._rest[:] = self._last
            model.revision = tick + 1
        else:
            self._interval = tick - self._seen_tick
            if self._follow(scene, model.velocity, self._interval * self.context.tick_s):
                model.revision = tick + 1
        model.position = scene.position
        model.quaternion = scene.quaternion
        model.sensed = self._seen_tick = tick

    def _follow(self, scene: Message, velocity: Array, elapsed_s: float) -> bool:
        """Estimate velocities; return whether a body starts or stops moving."""
        p = self._params
        rules = p.moved, p.turned, p.slow, p.turned / p.resting, p.resting, elapsed_s
        memory = self._last, self._rest, self._moving, self._slow_s
        return self._find(scene.position, scene.quaternion, *memory, velocity, rules)


@compiled_for(
    "f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], b1[::1], f8[::1], f8[:,::1], UniTuple(f8, 6)"
)
def find_motion(
    position: Array,  # (bodies, 3), m: as sensed
    quaternion: Array,  # (bodies, 4)
    last: Array,  # (bodies, 7): the same in the last scene; set to this one
    rest: Array,  # (bodies, 7): where bodies rested last
    moving: Mask,  # (bodies,)
    slow_s: Array,  # (bodies,): time for which they have been slow
    velocity: Array,  # (bodies, 3), m/s: set; zero for bodies at rest
    rules: tuple[float, float, float, float, float, float],
) -> bool:
    """Follow the bodies from scene to scene; return whether one starts or stops moving."""
    moved, turned, slow, slow_turn, resting, elapsed_s = (
        rules  # m, rad, m/s, rad/s, s, s: see `WorldParams`
    )
    changed = False
    for body in range(len(position)):
        speed = distance(position[body], last[body]) / elapsed_s
        is_slow = speed < slow and turn(quaternion[body], last[body]) < slow_turn * elapsed_s
        slow_s[body] = slow_s[body] + elapsed_s if is_slow else 0.0
        away = (
            distance(position[body], rest[body]) > moved
            or turn(quaternion[body], rest[body]) > turned
        )
        if moving[body] and slow_s[body] >= resting:
            rest[body, :3] = position[body]
            rest[body, 3:] = quaternion[body]
            moving[body] = False
            changed = True
        elif not moving[body] and away:
            moving[body] = True
            changed = True
        velocity[body] = 0.0
        if moving[body]:
            velocity[body] = (position[body] - last[body, :3]) / elapsed_s
        last[body, :3] = position[body]
        last[body, 3:] = quaternion[body]
    return changed


@compiled
def distance(position: Array, pose: Array) -> float:
    """Return the distance, m, of a position (3,) from that of a pose (7,)."""
    x = position[0] - pose[0]
    y = position[1] - pose[1]
    z = position[2] - pose[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def turn(quaternion: Array, pose: Array) -> float:
    """Return the angle, rad, between a quaternion (4,) and that of a pose (7,); q and -q are the
    same orientation."""
    product = (
        quaternion[0] * pose[3]
        + quaternion[1] * pose[4]
        + quaternion[2] * pose[5]
        + quaternion[3] * pose[6]
    )
    return 2.0 * math.acos(min(abs(product), 1.0))
