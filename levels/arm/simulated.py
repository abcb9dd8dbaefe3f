"""The arm and its cell in MuJoCo, with drives that keep the limits by themselves."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from backplane.message import Message
from levels.arm.arm import Sensed
from levels.arm.brake import Brake
from levels.arm.contact_monitor import ContactMonitor
from levels.arm.limits import LimitGate
from levels.arm.motion import ObstacleMotion
from levels.cell import STATE, Cell
from levels.dynamics import Dynamics
from levels.scene import SceneConfig

Array = NDArray[np.float64]

PATIENCE_TICKS = 4
"""Ticks for which the drives go on with the last command when none comes; then they brake. After as many missed beats
the supervisor calls a board dead."""


class SimulatedArm:
    """Implements `Arm`: `substeps` MuJoCo steps a tick; simulated time is tick times period, always.

    A command holds for one tick. It passes the limit gate in every tick, also in those that the servo level missed.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, clock_ns: int) -> None:
        self._cell, self._model = cell, cell.model
        self._data = cell.start()
        self._clock_ns = clock_ns
        self._substeps = round(clock_ns * 1e-9 / cell.model.opt.timestep)
        self._dynamics = Dynamics(cell)
        self._gate = LimitGate(cell.bounds, cell.limits.acceleration, clock_ns * 1e-9, self._dynamics)
        self._brake = Brake(cell.limits.acceleration, self._dynamics)
        self._monitor = ContactMonitor(cell)
        obstacles = cell.bodies[len(cell.object_qpos) :]
        names = scene.obstacles
        self._motions = [
            (mocap, ObstacleMotion(cell.model.body_pos[body], tuple(m for m in scene.motion if m.body == name)))
            for mocap, body, name in zip(cell.mocap, obstacles, names, strict=True)
        ]
        self._sensed = (np.zeros(len(cell.qpos)), np.zeros(len(cell.qpos)))
        self._sound = np.zeros(mujoco.mj_stateSize(cell.model, STATE))
        self._command: Array = np.zeros(len(cell.qpos))
        self._waited = PATIENCE_TICKS  # the brakes are on until the first command
        self.tick = 0
        self.torque: Array = np.zeros(len(cell.qpos))
        self.grip_force = 0.0
        self.clipped = 0
        self.fault = ""
        # A warning is a fault that `fault` tells; MuJoCo itself would write it to a file in the working directory.
        mujoco.set_mju_user_warning(lambda _: None)

    @property
    def touches(self) -> int:
        """Contacts that no task means, summed over all steps."""
        return self._monitor.count

    @property
    def first_touch(self) -> str:
        """The first such contact: which geoms, and when; empty: there was none."""
        return self._monitor.first

    def sense(self) -> Sensed:
        """Return joint positions and velocities, rad, rad/s, and the gripper's, m, m/s."""
        d, cell = self._data, self._cell
        position, velocity = self._sensed
        np.take(d.qpos, cell.qpos, out=position)
        np.take(d.qvel, cell.dof, out=velocity)
        if cell.gripper_qpos is None:
            return Sensed(position, velocity, 0.0, 0.0)
        return Sensed(position, velocity, float(d.qpos[cell.gripper_qpos]), float(d.qvel[cell.gripper_dof]))

    def drive(self, torque: Array, grip_force: float) -> None:
        """Give torques and gripper force for the coming tick. What is no number is never given: the drives brake."""
        self._waited = 0
        np.copyto(self._command, torque)
        if math.isfinite(grip_force) and self._cell.gripper_actuator is not None:
            self.grip_force = grip_force
        self._give()

    def step(self, ticks: int) -> None:
        """Simulate `ticks` ticks. After a fault the arm stands still in its last sound state; time goes on."""
        for _ in range(ticks):
            if self._waited:
                self._give()
            self._waited += 1
            if not self.fault:
                self._simulate()
            self.tick += 1
            self._data.time = self._now_s

    def look(self, scene: Message) -> None:
        """Fill a `SCENE`."""
        m, d, cell = self._model, self._data, self._cell
        mujoco.mj_kinematics(m, d)  # after a step, poses are those before it
        rows = len(cell.bodies)
        scene.position[:rows] = d.xpos[cell.bodies]
        scene.quaternion[:rows] = d.xquat[cell.bodies]
        scene.tool_position = d.site_xpos[cell.tool]
        mujoco.mju_mat2Quat(scene.tool_quaternion, d.site_xmat[cell.tool])

    def save(self, state: Message) -> None:
        """Fill an `ARM_STATE`."""
        mujoco.mj_getState(self._model, self._data, state.state, STATE)
        state.tick, state.clipped, state.touches = self.tick, self.clipped, self.touches

    def restore(self, state: Message) -> None:
        """Go on, bit for bit, from an `ARM_STATE`; its last torques are the last command."""
        d, cell = self._data, self._cell
        mujoco.mj_setState(self._model, d, state.state, STATE)
        self.tick, self.clipped, self._monitor.count = state.tick, state.clipped, state.touches
        np.take(d.ctrl, cell.actuators, out=self._command)
        np.copyto(self.torque, self._command)
        self.grip_force = float(d.ctrl[cell.gripper_actuator]) if cell.gripper_actuator is not None else 0.0
        self._waited = 0

    @property
    def _now_s(self) -> float:
        return self.tick * self._clock_ns * 1e-9

    def _give(self) -> None:
        """Pass the command, or the brake's, through the limit gate to the motors."""
        d, cell = self._data, self._cell
        q, qd, _, _ = self.sense()
        valid = bool(np.isfinite(self._command).all())
        if valid and self._waited < PATIENCE_TICKS:
            self._brake.release()
            wanted = self._command
        else:
            wanted = self._brake.torque(q, qd)
        passed, cut = self._gate.admit(wanted, q, qd)
        self.clipped += cut or not valid
        np.copyto(self.torque, passed)
        d.ctrl[cell.actuators] = passed
        if cell.gripper_actuator is not None:
            d.ctrl[cell.gripper_actuator] = self.grip_force

    def _simulate(self) -> None:
        """Simulate one tick; if that ends in a fault, the state before it stays."""
        m, d = self._model, self._data
        mujoco.mj_getState(m, d, self._sound, STATE)
        for mocap, motion in self._motions:
            d.mocap_pos[mocap] = motion.position(self._now_s)
        for _ in range(self._substeps):
            mujoco.mj_step(m, d)
            self._monitor.look(d, d.time)
        self.fault = self._broken()
        if self.fault:
            mujoco.mj_setState(m, d, self._sound, STATE)

    def _broken(self) -> str:
        """Return what is wrong with the simulation; empty: nothing."""
        d = self._data
        warned = np.flatnonzero(d.warning.number)
        if warned.size:
            return f"MuJoCo warning {mujoco.mjtWarning(warned[0]).name} at {self._now_s:.4f} s"
        if not (np.isfinite(d.qpos).all() and np.isfinite(d.qvel).all()):
            return f"the simulated state is not finite at {self._now_s:.4f} s"
        return ""
