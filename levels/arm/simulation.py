"""Simulation of a cell in MuJoCo: the steps of a tick, their checks, and moving obstacles."""

from __future__ import annotations

from copy import copy
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, Mask, norm
from rack.levels.arm.plant import Plant
from rack.levels.arm.substeps import copy_state, make_steps, prepare_substeps
from rack.levels.level import Finding
from rack.levels.messages import ArmState, Scene
from rack.levels.robot.cell import find_unintended_contacts
from rack.levels.robot.engine import SLEEP, mj_update_sleep, view_state
from rack.levels.robot.lookup import find_geom_name
from rack.levels.tables import MotionConfig, PushConfig, SceneConfig

STRUCK_TICKS = 40
"""Ticks for which motion is attributed to a blow, that is, an unintended contact.

They count from the contact, or from the last limit that was broken after it.
"""
STEPS_AT_REST = 10
"""Steps for which a body must be slower than `sleep_tolerance` before it sleeps.

This is MuJoCo's mjMINAWAKE.
"""
CHECKED_QUANTITIES = (("position", "rad"), ("velocity", "rad/s"), ("torque", "N m"))
"""Checked quantities of a joint, in the row order of a step."""


class Simulation(Plant):
    """A plant simulated with MuJoCo, in `substeps` steps per tick.

    Simulated time is the tick number times the duration of a tick, plus `late_s`. A tick before a
    late cycle is simulated in the same number of steps, which are longer. The simulated time is
    therefore exact, whereas a fraction of a tick has few whole steps, and each step is checked as
    in other ticks. Subclasses call `prepare_simulation` in their constructor, and set the controls
    of the drives before each `_simulate_tick`.
    """

    sleeps: ClassVar[bool] = True
    """True if bodies may sleep, because nothing except MuJoCo moves them."""

    def prepare_simulation(self, scene: SceneConfig, clock_ns: int) -> None:
        """Prepare the steps of a tick, which lasts `clock_ns`, and the checks on the steps."""
        cell = self.cell
        if self.sleeps:
            self._model = enable_sleep(cell.model, scene)
        self._clock_ns = clock_ns
        self._shift_s = 0.0  # simulated time minus the time of the tick
        steps = round(clock_ns * 1e-9 / cell.model.opt.timestep)
        self._steps = prepare_substeps(cell, self._model, self._data, steps)
        # True positions and velocities, (joints,) each.
        self._state = (self._steps.seen[-1, 0], self._steps.seen[-1, 1])
        self._read_joint_state()
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
        self._advance = make_steps.load_machine_code()
        self._copy_state = copy_state.load_machine_code()

    def _read_joint_state(self) -> None:
        """Read positions and velocities of the joints from MuJoCo's data.

        Call this after every change of the data other than a simulation step.
        """
        position, velocity = self._state
        position[:] = self._data.qpos[self.cell.qpos]
        velocity[:] = self._data.qvel[self.cell.dof]

    def describe_contact(self, contact: tuple[int, int] | NDArray[np.int32]) -> str:
        """Describe a `contact` as text, with the names of the geoms."""
        first, second = (find_geom_name(self.cell.model, geom) for geom in contact)
        return f"'{first}' touches '{second}'"

    def look(self, scene: Scene) -> None:
        """Fill a `Scene` with the simulated poses of bodies and tool."""
        self._fill_scene(scene)

    def save(self, state: ArmState) -> None:
        """Fill an `ArmState`, including the state of the simulation."""
        super().save(state)
        steps = self._steps
        self._copy_state(steps.model, steps.data, steps.asleep, state.state)

    def restore(self, state: ArmState) -> None:
        """Continue, bit for bit, from an `ArmState`."""
        super().restore(state)
        restore_state(self._model, self._data, state.state)
        self._read_joint_state()

    @property
    def _now_s(self) -> float:
        """Simulated time at the beginning of the tick, in s."""
        return self.tick * self._clock_ns * 1e-9 + self._shift_s

    @property
    def _tick_end_s(self) -> float:
        """Simulated time at the end of the tick, in s."""
        return (self.tick + 1) * self._clock_ns * 1e-9 + self._shift_s

    def _simulate_tick(self) -> None:
        """Simulate one tick: move obstacles, apply pushes, and make the steps."""
        for mocap, start, moves in self._motions:
            self._data.mocap_pos[mocap] = compute_obstacle_position(start, moves, self._now_s)
        for body, pushes in self._pushes:
            self._data.xfrc_applied[body, :3] = compute_push_force(pushes, self._now_s)
        usual_step_s: float | None = None
        if self.late_s != self._shift_s:
            # While the lateness of the clock changes, a tick is longer or shorter.
            option = self._model.opt
            usual_step_s = option.timestep
            option.timestep += (self.late_s - self._shift_s) / len(self._steps.seen)
            self._shift_s = self.late_s
        steps_made = self._advance(0, self._tick_end_s, *self._steps)
        if steps_made < 0:
            self._finish_failed_tick(steps_made)
        elif self.struck:
            self.struck -= 1
        if usual_step_s is not None:
            self._model.opt.timestep = usual_step_s

    def _finish_failed_tick(self, steps_made: int) -> None:
        """Finish a tick after one of its steps has failed a check.

        The remaining steps are made, and contacts and violated limits are counted and reported. If
        the simulation itself has failed, the state before the tick is restored instead.

        Args:
            steps_made: Number of steps made so far, negated, as `make_steps` returns it.
        """
        touches = self.touches
        while steps_made < 0:
            self._count_contacts()
            steps_made = self._advance(-steps_made, self._tick_end_s, *self._steps)
        if self.touches > touches and self.contact is not None:
            self.report_finding(Finding(Alarm.COLLISION, *self.contact))
            self.struck = STRUCK_TICKS
        is_broken = self._check_limits()
        if self.struck:
            self.struck = STRUCK_TICKS if is_broken else self.struck - 1
        self.fault = self._describe_failure()
        if self.fault:
            restore_state(self._model, self._data, self._steps.states[0])
            self._read_joint_state()
        self._data.time = self._tick_end_s

    def _count_contacts(self) -> None:
        """Count the unintended contacts of the last step, and store one of the arm or its load."""
        pairs = find_unintended_contacts(self._data, self.cell.geoms.touch)
        if not len(pairs):
            return
        if not self.first_touch:
            self.first_touch = (
                f"unintended contact: {self.describe_contact(pairs[0])} at {self._data.time:.3f} s"
            )
        self.touches += len(pairs)
        own_pairs = pairs[self._mark_own_geoms()[pairs].any(axis=1)]
        if len(own_pairs):
            self.contact = int(own_pairs[0, 0]), int(own_pairs[0, 1])

    def _mark_held_geoms(self) -> Mask:
        """Return a mask of the geoms of free bodies that the gripper touches, (ngeom,)."""
        pairs = self._data.contact.geom
        others = pairs[self._is_gripper[pairs].any(axis=1)].ravel()
        roots = self._root[others[~self._is_arm[others]]]
        return np.asarray(np.isin(self._root, roots[roots != 0]))

    def _mark_own_geoms(self) -> Mask:
        """Return a mask of the geoms of the arm and its load, (ngeom,)."""
        return np.asarray(self._is_arm | self._mark_held_geoms())

    def _check_limits(self) -> bool:
        """Check the joint limits in all steps of a tick. Return True if any is violated.

        Positions, velocities and torques (of motor and brake together) are checked. The check
        shares no code with the limit gate, which enforces the limits. For some time after an
        unintended contact, violated limits of position and velocity are counted separately, because
        no drive can prevent them.
        """
        seen = self._steps.seen
        low, high = self._steps.judged[:2]
        # The condition is negated so that NaN counts as a violation.
        violated = ~((seen >= low) & (seen <= high))
        is_wrong = steps = violated.any(axis=(1, 2))
        if self.struck:
            pushed = steps & ~violated[:, 2].any(axis=1) & np.isfinite(seen).all(axis=(1, 2))
            self.pushed += int(pushed.sum())
            steps = steps & ~pushed
        if steps.any():
            self.violations += int(steps.sum())
            self._report_violation(violated, int(steps.argmax()))
        return bool(is_wrong.any())

    def _report_violation(self, violated: Mask, step: int) -> None:
        """Report the first limit violated in step `step`. `violated` is (steps, 3, joints)."""
        row, joint = (int(at[0]) for at in np.nonzero(violated[step]))
        value = float(self._steps.seen[step, row, joint])
        if not self.first_violation:
            quantity, unit = CHECKED_QUANTITIES[row]
            low, high = self._steps.judged[:2, row, joint]
            self.first_violation = (
                f"{quantity} {value:.6g} {unit} of joint '{self.cell.joints[joint]}' at"
                f" {self._now_s:.4f} s, step {step}; {low:g} to {high:g} is permitted"
            )
        self.report_finding(Finding(Alarm.LIMIT_EXCEEDED, joint, value))

    def _describe_failure(self) -> str:
        """Return a description of a failure of the simulation, or an empty string."""
        d = self._data
        warned = np.flatnonzero(d.warning.number)
        if warned.size:
            return f"MuJoCo warning {mujoco.mjtWarning(warned[0]).name} at {self._now_s:.4f} s"
        if not (np.isfinite(d.qpos).all() and np.isfinite(d.qvel).all()):
            return f"the simulated state is not finite at {self._now_s:.4f} s"
        return ""


def compute_obstacle_position(
    start: Array, moves: tuple[MotionConfig, ...], time_s: float
) -> Array:
    """Return the position of a moving obstacle at a given time, (3,), in m.

    A move that starts before the previous one has ended replaces it.

    Args:
        start: Position before the first move, (3,), m.
        moves: Moves of the obstacle.
        time_s: Simulated time, s.
    """
    ordered = sorted(moves, key=lambda move: move.at)
    ends = (*(later.at for later in ordered[1:]), np.inf)
    place = start
    for move, end in zip(ordered, ends, strict=False):
        if time_s <= move.at:
            break
        offset = np.array(move.to) - place
        length = norm(offset)
        driven = move.speed * (min(time_s, end) - move.at)
        place = np.array(move.to) if driven >= length else place + offset * (driven / length)
    return place


def compute_push_force(pushes: tuple[PushConfig, ...], time_s: float) -> Array:
    """Return the total force of the pushes on an object at simulated time `time_s`, (3,), in N."""
    total = np.zeros(3)
    for push in pushes:
        elapsed_s = time_s - push.at
        remaining_s = push.at + push.seconds - time_s
        if elapsed_s >= 0.0 and remaining_s > 0.0:
            share = 1.0
            if push.rise > 0.0:
                share = min(1.0, elapsed_s / push.rise, remaining_s / push.rise)
            total += np.array(push.force) * share
    return total


def enable_sleep(model: mujoco.MjModel, scene: SceneConfig) -> mujoco.MjModel:
    """Return a copy of the model in which bodies at rest may sleep, if that is safe.

    Sleep is not safe if a mocap body moves, because its motion does not wake other bodies. It is
    not safe with tendon equalities or flexible bodies, because MuJoCo ends the process if these
    might sleep. If steps are short or gravity is weak, it is not safe because a body would fall
    asleep in the air, at the top of its flight. Use the model for whole steps only, because the
    separate functions for parts of a step omit bodies that do not move.
    """
    result = copy(model)
    option = result.opt
    gained = STEPS_AT_REST * option.timestep * norm(option.gravity)  # m/s, in a fall
    tendons = model.eq_type == mujoco.mjtEq.mjEQ_TENDON
    # At the top of its flight, a body would be slow for more than `STEPS_AT_REST` steps.
    may_float = gained < 4.0 * option.sleep_tolerance
    if not (may_float or scene.motion or tendons.any() or model.nflex):
        option.enableflags |= SLEEP
    return result


def restore_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Restore a saved state to `data`, so that the simulation continues bit for bit."""
    data.tree_asleep[:] = -1
    mj_update_sleep(model._address, data._address)
    view_state(model, data, state)
    asleep = state[state.size - model.ntree :]
    if (asleep >= 0).any():
        # Steps skip quantities of sleeping bodies, so compute them once while all are awake.
        mujoco.mj_forward(model, data)
        view_state(model, data, state)
    data.tree_asleep[:] = asleep
    mj_update_sleep(model._address, data._address)
