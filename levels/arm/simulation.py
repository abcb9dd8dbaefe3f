"""The simulation of a cell: the ticks of a plant in MuJoCo, judged at every step, and what moves by
itself in it."""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar

import mujoco
import numpy as np

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, norm
from rack.levels.arm.monitors import ContactMonitor, LimitMonitor
from rack.levels.arm.plant import Plant
from rack.levels.arm.substeps import advance, copy_state, substeps
from rack.levels.level import Finding
from rack.levels.robot.state import restore_state, sleeping
from rack.levels.tables import MotionConfig, PushConfig, SceneConfig

STRUCK_TICKS = 40
"""Ticks after a contact, or after the last limit broken since, in which the motion is blamed on the
blow."""


class Simulation(Plant):
    """A plant in MuJoCo: `substeps` steps a tick; simulated time is tick times period, always.

    Subclasses call `begin` when the plant is made, and give the drives their commands before each
    `_simulate`.
    """

    sleeps: ClassVar[bool] = True
    """Whether its bodies may sleep: nothing but MuJoCo moves them."""

    def begin(self, scene: SceneConfig, clock_ns: int) -> None:
        """Prepare the steps of a tick of `clock_ns`, and what judges them."""
        cell = self.cell
        d = self._data
        self._model = sleeping(cell.model, scene) if self.sleeps else cell.model
        self._clock_ns = clock_ns
        self._poses = self._poses._replace(model=self._model._address)  # else all would wake
        steps = round(clock_ns * 1e-9 / cell.model.opt.timestep)
        self._steps = substeps(cell, self._model, d, steps)
        self._state = (
            self._steps.seen[-1, 0],
            self._steps.seen[-1, 1],
        )  # (joints,): true positions and velocities
        self._refresh()
        self._saving = self._steps.model, self._steps.data, self._steps.asleep  # for `copy_state`
        self._contacts = ContactMonitor(cell)
        self._limits = LimitMonitor(cell, self._steps)
        obstacles = zip(
            cell.mocap, cell.bodies[len(cell.object_qpos) :], scene.obstacles, strict=True
        )
        self._motions = [
            (
                mocap,
                ObstacleMotion(
                    cell.model.body_pos[body], tuple(m for m in scene.motion if m.body == name)
                ),
            )
            for mocap, body, name in obstacles
        ]
        self._pushes = [
            (int(body), pushes)
            for body, name in zip(cell.bodies, scene.objects, strict=False)
            if (pushes := tuple(push for push in scene.push if push.body == name))
        ]
        self._advance = advance.load()
        self._copy_state = copy_state.load()

    def _refresh(self) -> None:
        """Take positions and velocities of the joints from MuJoCo's state, after it was set other
        than by a step."""
        position, velocity = self._state
        position[:] = self._data.qpos[self.cell.qpos]
        velocity[:] = self._data.qvel[self.cell.dof]

    def named(self, contact: tuple[int, int]) -> str:
        """Return a `contact` in words: the names of the geoms."""
        return self._contacts.named(contact)

    def look(self, scene: Message) -> None:
        """Fill a `SCENE` with the poses as simulated."""
        self._show(scene)

    def save(self, state: Message) -> None:
        """Fill an `ARM_STATE`."""
        super().save(state)
        self._copy_state(*self._saving, state.state)

    def restore(self, state: Message) -> None:
        """Continue, bit for bit, from an `ARM_STATE`."""
        super().restore(state)
        restore_state(self._model, self._data, state.state)
        self._contacts.count = state.touches
        self._limits.count = state.violations
        self._limits.pushed = state.pushed
        self._refresh()

    @property
    def _now_s(self) -> float:
        return self.tick * self._clock_ns * 1e-9

    @property
    def _after_s(self) -> float:
        return (self.tick + 1) * self._clock_ns * 1e-9

    def _simulate(self) -> None:
        """Simulate one tick."""
        for mocap, motion in self._motions:
            self._data.mocap_pos[mocap] = motion.position(self._now_s)
        for body, pushes in self._pushes:
            self._data.xfrc_applied[body, :3] = push_force(pushes, self._now_s)
        made = self._advance(0, (self.tick + 1) * self._clock_ns * 1e-9, *self._steps)
        if made < 0:
            self._look_closer(-made)
        elif self.struck:
            self.struck -= 1

    def _look_closer(self, made: int) -> None:
        """Finish a tick in which step `made` failed a check; on a fault, restore the state before
        the tick."""
        touches = self._contacts.count
        self._contacts.struck = self.contact
        self._contacts.look(self._data)
        while made < len(self._steps.seen):
            made = self._advance(made, self._after_s, *self._steps)
            if made < 0:
                made = -made
                self._contacts.look(self._data)
        if self._contacts.count > touches and self._contacts.struck is not None:
            self.find(Finding(Alarm.COLLISION, *self._contacts.struck))
            self.struck = STRUCK_TICKS
        violations = self._limits.count
        broken = self._limits.judge(self._now_s, self.struck > 0)
        if self._limits.count > violations:
            self.find(self._limits.finding)
        if self.struck:
            self.struck = STRUCK_TICKS if broken else self.struck - 1
        self.fault = self._broken()
        if self.fault:
            restore_state(self._model, self._data, self._steps.states[0])
            self._refresh()
        self._data.time = self._after_s
        contacts = self._contacts
        limits = self._limits
        self.contact = contacts.struck
        self.touches = contacts.count
        self.first_touch = contacts.first
        self.violations = limits.count
        self.pushed = limits.pushed
        self.first_violation = limits.first

    def _broken(self) -> str:
        """Return the fault of the simulation; empty: none."""
        d = self._data
        warned = np.flatnonzero(d.warning.number)
        if warned.size:
            return f"MuJoCo warning {mujoco.mjtWarning(warned[0]).name} at {self._now_s:.4f} s"
        if not (np.isfinite(d.qpos).all() and np.isfinite(d.qvel).all()):
            return f"the simulated state is not finite at {self._now_s:.4f} s"
        return ""


class ObstacleMotion:
    """The moves of one obstacle; a move that starts before the last one has ended cuts it short."""

    def __init__(self, start: Array, moves: tuple[MotionConfig, ...]) -> None:
        """Start at the place `start`, (3,), m."""
        self._start = np.array(start)
        self._moves = tuple(sorted(moves, key=lambda move: move.at))
        self._ends = (*(later.at for _, later in pairwise(self._moves)), np.inf)

    def position(self, time_s: float) -> Array:
        """Return the obstacle's origin (3,), m, at simulated `time_s`."""
        place = self._start
        for move, end in zip(self._moves, self._ends, strict=False):
            if time_s <= move.at:
                break
            way = np.array(move.to) - place
            length = norm(way)
            driven = move.speed * (min(time_s, end) - move.at)
            place = np.array(move.to) if driven >= length else place + way * (driven / length)
        return place


def push_force(pushes: tuple[PushConfig, ...], time_s: float) -> Array:
    """Return the sum of the pushes on an object, (3,), N, at simulated `time_s`."""
    total = np.zeros(3)
    for push in pushes:
        since = time_s - push.at
        left = push.at + push.seconds - time_s
        if since >= 0.0 and left > 0.0:
            share = 1.0
            if push.rise > 0.0:
                share = min(1.0, since / push.rise, left / push.rise)
            total += np.array(push.force) * share
    return total
