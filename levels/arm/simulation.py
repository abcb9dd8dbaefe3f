"""The simulation of a cell: the ticks of a plant in MuJoCo, judged at every step, and what moves by
itself in it.
"""

from __future__ import annotations

from copy import copy
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, Mask, norm
from rack.levels.arm.plant import Plant
from rack.levels.arm.substeps import advance, copy_state, substeps
from rack.levels.level import Finding
from rack.levels.messages import ArmState, Scene
from rack.levels.robot.cell import unintended_contacts
from rack.levels.robot.engine import SLEEP, mj_update_sleep, view_state
from rack.levels.robot.lookup import geom_name
from rack.levels.tables import MotionConfig, PushConfig, SceneConfig

STRUCK_TICKS = 40
"""Ticks after a contact, or after the last limit broken since, in which the motion is blamed on the
blow."""
STEPS_AT_REST = 10
"""Steps in which a body is slower than `sleep_tolerance` before it sleeps: MuJoCo's mjMINAWAKE."""
QUANTITIES = (("position", "rad"), ("velocity", "rad/s"), ("torque", "N m"))
"""What is judged of a joint, by row of a step."""


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
        if self.sleeps:
            self._model = sleeping(cell.model, scene)
        self._clock_ns = clock_ns
        steps = round(clock_ns * 1e-9 / cell.model.opt.timestep)
        self._steps = substeps(cell, self._model, self._data, steps)
        self._state = (
            self._steps.seen[-1, 0],
            self._steps.seen[-1, 1],
        )  # (joints,): true positions and velocities
        self._refresh()
        self._is_arm, self._is_gripper = np.zeros((2, cell.model.ngeom), dtype=bool)
        self._is_arm[cell.geoms.arm] = self._is_gripper[cell.geoms.gripper] = True
        self._root = cell.model.body_rootid[cell.model.geom_bodyid]
        obstacles = zip(
            cell.mocap, cell.bodies[len(cell.object_qpos) :], scene.obstacles, strict=True
        )
        self._motions = [
            (mocap, cell.model.body_pos[body], tuple(m for m in scene.motion if m.body == name))
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
        than by a step.
        """
        position, velocity = self._state
        position[:] = self._data.qpos[self.cell.qpos]
        velocity[:] = self._data.qvel[self.cell.dof]

    def named(self, contact: tuple[int, int] | NDArray[np.int32]) -> str:
        """Return a `contact` in words: the names of the geoms."""
        first, second = (geom_name(self.cell.model, geom) for geom in contact)
        return f"'{first}' touches '{second}'"

    def look(self, scene: Scene) -> None:
        """Fill a `SCENE` with the poses as simulated."""
        self._show(scene)

    def save(self, state: ArmState) -> None:
        """Fill an `ARM_STATE`."""
        super().save(state)
        steps = self._steps
        self._copy_state(steps.model, steps.data, steps.asleep, state.state)

    def restore(self, state: ArmState) -> None:
        """Continue, bit for bit, from an `ARM_STATE`."""
        super().restore(state)
        restore_state(self._model, self._data, state.state)
        self._refresh()

    @property
    def _now_s(self) -> float:
        return self.tick * self._clock_ns * 1e-9

    @property
    def _after_s(self) -> float:
        return (self.tick + 1) * self._clock_ns * 1e-9

    def _simulate(self) -> None:
        """Simulate one tick."""
        for mocap, start, moves in self._motions:
            self._data.mocap_pos[mocap] = obstacle_position(start, moves, self._now_s)
        for body, pushes in self._pushes:
            self._data.xfrc_applied[body, :3] = push_force(pushes, self._now_s)
        made = self._advance(0, self._after_s, *self._steps)
        if made < 0:
            self._look_closer(-made)
        elif self.struck:
            self.struck -= 1

    def _look_closer(self, made: int) -> None:
        """Finish a tick in which step `made` failed a check; on a fault, restore the state before
        the tick.
        """
        touches = self.touches
        self._count_contacts()
        while made < len(self._steps.seen):
            made = self._advance(made, self._after_s, *self._steps)
            if made < 0:
                made = -made
                self._count_contacts()
        if self.touches > touches and self.contact is not None:
            self.find(Finding(Alarm.COLLISION, *self.contact))
            self.struck = STRUCK_TICKS
        is_broken = self._judge_limits()
        if self.struck:
            self.struck = STRUCK_TICKS if is_broken else self.struck - 1
        self.fault = self._broken()
        if self.fault:
            restore_state(self._model, self._data, self._steps.states[0])
            self._refresh()
        self._data.time = self._after_s

    def _count_contacts(self) -> None:
        """Count the unintended contacts of the last step; keep one of the plant, or of its load."""
        pairs = unintended_contacts(self._data, self.cell.geoms.touch)
        if not len(pairs):
            return
        if not self.first_touch:
            named = self.named(pairs[0])
            self.first_touch = f"unintended contact: {named} at {self._data.time:.3f} s"
        self.touches += len(pairs)
        ours = pairs[self._ours()[pairs].any(axis=1)]
        if len(ours):
            self.contact = int(ours[0, 0]), int(ours[0, 1])

    def _held(self) -> Mask:
        """Mark (ngeom,) the geoms of free bodies that the gripper touches."""
        pairs = self._data.contact.geom
        others = pairs[self._is_gripper[pairs].any(axis=1)].ravel()
        roots = self._root[others[~self._is_arm[others]]]
        return np.asarray(np.isin(self._root, roots[roots != 0]))

    def _ours(self) -> Mask:
        """Mark (ngeom,) the geoms of the arm and of its load."""
        return np.asarray(self._is_arm | self._held())

    def _judge_limits(self) -> bool:
        """Judge position, velocity and torque, of motor and brake together, in every step of a
        tick; return whether one broke a limit.

        It shares no code with the limit gate, which enforces the limits. A blow that still moves
        the arm breaks those of position and velocity: no drive can prevent it.
        """
        seen = self._steps.seen
        low, high = self._steps.judged[:2]
        wrong = ~((seen >= low) & (seen <= high))  # NaN is not within limits either
        is_wrong = steps = wrong.any(axis=(1, 2))
        if self.struck:
            pushed = steps & ~wrong[:, 2].any(axis=1) & np.isfinite(seen).all(axis=(1, 2))
            self.pushed += int(pushed.sum())
            steps = steps & ~pushed
        if steps.any():
            self.violations += int(steps.sum())
            self._report_violation(wrong, int(steps.argmax()))
        return bool(is_wrong.any())

    def _report_violation(self, wrong: Mask, step: int) -> None:
        """Report the first limit that a step broke."""
        part, joint = (int(at[0]) for at in np.nonzero(wrong[step]))
        value = float(self._steps.seen[step, part, joint])
        if not self.first_violation:
            what, unit = QUANTITIES[part]
            where = f"joint '{self.cell.joints[joint]}' at {self._now_s:.4f} s, step {step}"
            low, high = self._steps.judged[:2, part, joint]
            permitted = f"{low:g} to {high:g} is permitted"
            self.first_violation = f"{what} {value:.6g} {unit} of {where}; {permitted}"
        self.find(Finding(Alarm.LIMIT_EXCEEDED, joint, value))

    def _broken(self) -> str:
        """Return the fault of the simulation; empty: none."""
        d = self._data
        warned = np.flatnonzero(d.warning.number)
        if warned.size:
            return f"MuJoCo warning {mujoco.mjtWarning(warned[0]).name} at {self._now_s:.4f} s"
        if not (np.isfinite(d.qpos).all() and np.isfinite(d.qvel).all()):
            return f"the simulated state is not finite at {self._now_s:.4f} s"
        return ""


def obstacle_position(start: Array, moves: tuple[MotionConfig, ...], time_s: float) -> Array:
    """Return the origin of an obstacle that starts at `start`, (3,), m, at simulated `time_s`; a
    move that starts before the last one has ended cuts it short.
    """
    ordered = sorted(moves, key=lambda move: move.at)
    ends = (*(later.at for later in ordered[1:]), np.inf)
    place = start
    for move, end in zip(ordered, ends, strict=False):
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


def sleeping(model: mujoco.MjModel, scene: SceneConfig) -> mujoco.MjModel:
    """Return the model to step a simulation with: bodies at rest sleep where all that could move
    them wakes them.

    A mocap body that moves does not, and MuJoCo ends the process at tendon equalities and flexible
    bodies that might sleep. Where steps are short, or gravity weak, a body would sleep in the air,
    at the turning point of its flight. Only for whole steps: parts of one, called by themselves,
    leave out what does not move.
    """
    found = copy(model)
    option = found.opt
    gained = STEPS_AT_REST * option.timestep * norm(option.gravity)  # m/s, in falling
    tendons = model.eq_type == mujoco.mjtEq.mjEQ_TENDON
    lingers = gained < 4.0 * option.sleep_tolerance  # in the air, for longer than those steps
    if not (lingers or scene.motion or tendons.any() or model.nflex):
        option.enableflags |= SLEEP
    return found


def restore_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Set `data` to a state, so that its next steps are those of the data that was saved."""
    data.tree_asleep[:] = -1
    mj_update_sleep(model._address, data._address)
    view_state(model, data, state)
    asleep = state[state.size - model.ntree :]
    if (asleep >= 0).any():
        # Steps no longer compute what belongs to sleeping bodies: here, once, while they are awake.
        mujoco.mj_forward(model, data)
        view_state(model, data, state)
    data.tree_asleep[:] = asleep
    mj_update_sleep(model._address, data._address)
