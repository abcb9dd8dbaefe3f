"""The arm and its cell in MuJoCo, with drives that keep the limits by themselves."""

from __future__ import annotations

import math
from itertools import pairwise

import mujoco
import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array, norm
from rack.levels.arm.arm import Arm, Sensed
from rack.levels.arm.drives import Brake, CoarseSensors, LimitGate, give
from rack.levels.arm.monitors import ContactMonitor, LimitMonitor
from rack.levels.arm.substeps import advance, copy_state, substeps
from rack.levels.arm.wrist import WristSensor
from rack.levels.level import Finding
from rack.levels.robot.cell import STATE, Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.engine import one_view
from rack.levels.tables import MotionConfig, SceneConfig

STRUCK_TICKS = 40
"""Ticks after a contact, or after the last limit broken since, in which the motion is blamed on the blow."""


class SimulatedArm(Arm):
    """Implements `Arm`: `substeps` MuJoCo steps a tick; simulated time is tick times period, always.

    Samples are as coarse and noisy as the cell's encoders; brakes and limit gate belong to the drives and see the
    truth. A command is for one torque cycle. It passes the limit gate in every tick, even in those that the servo level
    missed.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        d, joints = self._data, len(cell.qpos)
        self._model, self._clock_ns = cell.model, clock_ns
        self._steps = substeps(cell, d, round(clock_ns * 1e-9 / cell.model.opt.timestep))
        self._state = self._steps.seen[-1, 0], self._steps.seen[-1, 1]  # (joints,): true positions and velocities
        self._refresh()
        self._addresses = self._steps.model, self._steps.data
        # Memory views: single numbers in a third of the time that arrays take.
        self._qpos: memoryview[float] = memoryview(d.qpos)
        self._qvel: memoryview[float] = memoryview(d.qvel)
        self._ctrl: memoryview[float] = memoryview(d.ctrl)
        self._grip = cell.gripper_actuator
        gripped = cell.gripper_qpos, cell.gripper_dof
        self._gripper = None if gripped[0] is None or gripped[1] is None else (gripped[0], gripped[1])
        self._contacts, self._limits = ContactMonitor(cell), LimitMonitor(cell, self._steps)
        dynamics = Dynamics(cell)
        self._gate = LimitGate(cell.bounds, cell.limits.acceleration, clock_ns * 1e-9, dynamics)
        self._brake = Brake(cell.limits.acceleration, dynamics, cell.home)
        self._most: Array | None = None  # (joints,), N m: torques of weakened motors
        obstacles = zip(cell.mocap, cell.bodies[len(cell.object_qpos) :], scene.obstacles, strict=True)
        self._motions = [
            (mocap, ObstacleMotion(cell.model.body_pos[body], tuple(m for m in scene.motion if m.body == name)))
            for mocap, body, name in obstacles
        ]
        self._coarse = None if cell.encoders.exact else CoarseSensors(cell.encoders, seed)
        self._wrist = None if cell.wrist is None else WristSensor(cell.wrist, d, seed)
        # N m: the newest command, the one in force, and its torque as given.
        self._asked, self._command, self.torque = torques = np.zeros((3, joints))
        self._given = False  # the command for the coming tick has passed the gate
        memory, (qpos, qvel, ctrl, brakes) = one_view(d.qpos, d.qvel, d.ctrl, d.qfrc_applied)
        places = np.stack((qpos + cell.qpos, qvel + cell.dof, ctrl + cell.actuators, brakes + cell.dof))
        self._clear = torques, self.dynamics.newest, *self._gate.clearance, places, memory
        self._give_clear, self._advance, self._copy_state = give.load(), advance.load(), copy_state.load()
        if self._wrist is not None:  # until the first step it senses an arm that is braked, not one that falls
            self._give()
            mujoco.mj_forward(cell.model, d)
        # A warning is a fault, reported in `fault`; MuJoCo itself would write it to a file in the working directory.
        mujoco.set_mju_user_warning(lambda _: None)

    @property
    def holds(self) -> bool:
        """Whether the gripper touches a part."""
        return self._contacts.holds(self._data)

    @property
    def leans(self) -> bool:
        """Whether the arm, or its load, touches anything else."""
        return self._contacts.leans(self._data)

    def named(self, contact: tuple[int, int]) -> str:
        """Return a `contact` in words: the names of the geoms."""
        return self._contacts.named(contact)

    def sense(self) -> Sensed:
        """Return joint positions and velocities, rad, rad/s, and the gripper's, m, m/s."""
        position, velocity = self._state
        if self._coarse is not None:
            position, velocity = self._coarse.sample(position, velocity, self.tick)
        if self._gripper is None:
            return Sensed(position, velocity, 0.0, 0.0, self.tick)
        at, dof = self._gripper
        return Sensed(position, velocity, self._qpos[at], self._qvel[dof], self.tick)

    def _refresh(self) -> None:
        """Take positions and velocities of the joints from MuJoCo's state, after it was set other than by a step."""
        position, velocity = self._state
        position[:], velocity[:] = self._data.qpos[self.cell.qpos], self._data.qvel[self.cell.dof]

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and give torques and gripper force for the coming torque cycle; see `Link.drive`."""
        self._asked[:] = torque
        if self._grip is not None and math.isfinite(grip_force):
            self._ctrl[self._grip] = self.grip_force = grip_force
        if self._most is None and self._give_clear(*self._clear):
            self.waited, self.braked, self._given = 0, False, True
            return None
        finding = self.refused(torque)
        if finding is not None:
            self.clipped += 1
            self.brake()
            return finding
        self.waited, self.braked = 0, False
        self._command[:] = torque
        self._give()
        return None

    def brake(self) -> None:
        """Engage the brakes; the motors give nothing, the gripper keeps its force."""
        self._engage()
        self._give()

    def _engage(self) -> None:
        if not self.braked:
            self.braked = True
            self._brake.hold_at(self._state[0])

    def weaken(self, most: Array | None) -> None:
        """Limit the motors to `most` (joints,), N m, from the next command on; None: they are sound."""
        self._most = most

    def step(self, ticks: int) -> None:
        """Simulate `ticks` ticks. After a fault the arm stands still in its last sound state; time continues."""
        self.contact = None
        for _ in range(ticks):
            if self.waited >= self.patience:
                self._engage()
            if not self._given:
                self._give()
            self._given = False
            self.waited += 1
            if not self.fault:
                self._simulate()
            self.tick += 1
        if self.fault:
            self._data.time = self._now_s

    def feel(self) -> Array | None:
        """Return the sample of the wrist sensor, (6,), N, N m: that of a substep ago, as MuJoCo's are."""
        return None if self._wrist is None else self._wrist.sample(self.tick)

    def look(self, scene: Message) -> None:
        """Fill a `SCENE` with the poses as simulated."""
        self._show(scene)

    def save(self, state: Message) -> None:
        """Fill an `ARM_STATE`."""
        before = self._saved
        super().save(state)
        self._copy_state(*self._addresses, state.state)
        if self.braked or self._saved is not before:
            state.rest = self._brake.rest

    def restore(self, state: Message) -> None:
        """Continue, bit for bit, from an `ARM_STATE`; its last torques are the last command."""
        super().restore(state)
        d, cell = self._data, self.cell
        mujoco.mj_setState(self._model, d, state.state, STATE)
        self._contacts.count = state.touches
        self._limits.count, self._limits.pushed = state.violations, state.pushed
        np.copyto(self._brake.rest, state.rest)
        np.take(d.ctrl, cell.actuators, out=self._command)
        np.copyto(self.torque, self._command)
        self.grip_force = 0.0 if self._grip is None else self._ctrl[self._grip]
        self._given = True
        self._refresh()

    @property
    def _now_s(self) -> float:
        return self.tick * self._clock_ns * 1e-9

    @property
    def _after_s(self) -> float:
        return (self.tick + 1) * self._clock_ns * 1e-9

    def _give(self) -> None:
        """Apply the command to the motors, or the brakes' torque to the joints, through the limit gate."""
        cell, braked = self.cell, self.braked
        q, qd = self._state
        passed, cut = self._gate.admit(self._brake.torque(q, qd) if braked else self._command, q, qd)
        self.clipped += cut
        self._data.qfrc_applied[cell.dof] = passed if braked else 0.0
        np.copyto(self.torque, 0.0 if braked else passed)
        given = self.torque if self._most is None else np.clip(self.torque, -self._most, self._most)
        self._data.ctrl[cell.actuators] = given
        self._given = True

    def _simulate(self) -> None:
        """Simulate one tick."""
        for mocap, motion in self._motions:
            self._data.mocap_pos[mocap] = motion.position(self._now_s)
        made = self._advance(0, (self.tick + 1) * self._clock_ns * 1e-9, *self._steps)
        if made < 0:
            self._look_closer(-made)
        elif self.struck:
            self.struck -= 1

    def _look_closer(self, made: int) -> None:
        """Finish a tick in which step `made` failed a check; on a fault, restore the state before the tick."""
        touches, self._contacts.struck = self._contacts.count, self.contact
        self._contacts.look(self._data)
        while made < len(self._steps.seen):
            made = self._advance(made, self._after_s, *self._steps)
            if made < 0:
                made = -made
                self._contacts.look(self._data)
        if self._contacts.count > touches and self._contacts.struck is not None:
            self.struck = STRUCK_TICKS
        broken = self._limits.judge(self._now_s, self.struck > 0)
        if self.struck:
            self.struck = STRUCK_TICKS if broken else self.struck - 1
        self.fault = self._broken()
        if self.fault:
            mujoco.mj_setState(self._model, self._data, self._steps.states[0], STATE)
            self._refresh()
        self._data.time = self._after_s
        contacts, limits = self._contacts, self._limits
        self.contact, self.touches, self.first_touch = contacts.struck, contacts.count, contacts.first
        self.violations, self.pushed, self.first_violation = limits.count, limits.pushed, limits.first

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
