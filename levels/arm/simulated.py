"""The arm and its cell in MuJoCo, with drives that keep the limits by themselves."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.arm.arm import Sensed
from rack.levels.arm.brake import Brake
from rack.levels.arm.coarse_sensors import CoarseSensors
from rack.levels.arm.contact_monitor import ContactMonitor
from rack.levels.arm.limit_monitor import LimitMonitor
from rack.levels.arm.limits import LimitGate
from rack.levels.arm.motion import ObstacleMotion
from rack.levels.cell import STATE, Cell
from rack.levels.dynamics import Dynamics
from rack.levels.level import Finding
from rack.levels.scene import SceneConfig

Array = NDArray[np.float64]

PATIENCE_CYCLES = 2
"""Torque cycles for which the motors go on with the last command when none comes; then the brakes close."""
FARTHEST = 1.001
"""Multiple of a torque limit beyond which a command is none that a servo level gives: it keeps the limits itself."""


STRUCK_TICKS = 40
"""Ticks behind a contact, or behind the last limit broken after it, for which the arm moves on from the blow."""


class SimulatedArm:
    """Implements `Arm`: `substeps` MuJoCo steps a tick; simulated time is tick times period, always.

    Samples are as coarse and noisy as the cell's encoders; brakes and limit gate are the drives' own and see the truth.

    A command is for one torque cycle, `every` ticks. It passes the limit gate in every tick, also in those that the
    servo level missed.
    """

    def __init__(self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0) -> None:
        self._cell, self._model = cell, cell.model
        self._data = cell.start()
        self._clock_ns = clock_ns
        self._patience = PATIENCE_CYCLES * every
        self._substeps = round(clock_ns * 1e-9 / cell.model.opt.timestep)
        self._dynamics = Dynamics(cell)
        self._gate = LimitGate(cell.bounds, cell.limits.acceleration, clock_ns * 1e-9, self._dynamics)
        self._brake = Brake(cell.limits.acceleration, self._dynamics)
        self._brake.close(cell.home)  # until the first command
        self._contacts = ContactMonitor(cell)
        self._limits = LimitMonitor(cell, self._data, self._substeps)
        self._farthest = FARTHEST * cell.bounds.torque
        self._most: Array | None = None
        obstacles = cell.bodies[len(cell.object_qpos) :]
        names = scene.obstacles
        self._motions = [
            (mocap, ObstacleMotion(cell.model.body_pos[body], tuple(m for m in scene.motion if m.body == name)))
            for mocap, body, name in zip(cell.mocap, obstacles, names, strict=True)
        ]
        self._true = (np.zeros(len(cell.qpos)), np.zeros(len(cell.qpos)))
        self._coarse = None if cell.encoders.exact else CoarseSensors(cell.encoders, seed)
        self._struck = 0  # ticks for which the arm still moves on from a blow
        self._sound = np.zeros(mujoco.mj_stateSize(cell.model, STATE))
        self._command: Array = np.zeros(len(cell.qpos))
        self._given = False  # for the coming tick
        self.waited = self._patience
        self.tick = 0
        self.torque: Array = np.zeros(len(cell.qpos))
        self.grip_force = 0.0
        self.clipped = 0
        self.fault = ""
        # A warning is a fault that `fault` tells; MuJoCo itself would write it to a file in the working directory.
        mujoco.set_mju_user_warning(lambda _: None)

    @property
    def braked(self) -> bool:
        """Whether the brakes are closed."""
        return self._brake.closed

    @property
    def contact(self) -> tuple[int, int] | None:
        """The geoms of an unintended contact of the arm, or of what it holds, in the last `step`."""
        return self._contacts.struck

    @property
    def holds(self) -> bool:
        """Whether the gripper touches a part."""
        return self._contacts.holds(self._data)

    @property
    def leans(self) -> bool:
        """Whether the arm, or what it holds, touches anything else."""
        return self._contacts.leans(self._data)

    def named(self, contact: tuple[int, int]) -> str:
        """Return what touches what."""
        return self._contacts.named(contact)

    @property
    def touches(self) -> int:
        """Contacts that no task means, summed over all steps."""
        return self._contacts.count

    @property
    def first_touch(self) -> str:
        """The first such contact: which geoms, and when; empty: there was none."""
        return self._contacts.first

    @property
    def violations(self) -> int:
        """Steps of the simulation in which the arm's own drives broke a limit."""
        return self._limits.count

    @property
    def pushed(self) -> int:
        """Steps in which what struck the arm pushed a joint beyond a limit of position or velocity."""
        return self._limits.pushed

    @property
    def first_violation(self) -> str:
        """The first of them: which limit, by how much, and when; empty: there was none."""
        return self._limits.first

    def sense(self) -> Sensed:
        """Return joint positions and velocities, rad, rad/s, and the gripper's, m, m/s."""
        d, cell = self._data, self._cell
        position, velocity = self._state()
        if self._coarse is not None:
            position, velocity = self._coarse.sample(position, velocity, self.tick)
        if cell.gripper_qpos is None:
            return Sensed(position, velocity, 0.0, 0.0, self.tick)
        opening, speed = float(d.qpos[cell.gripper_qpos]), float(d.qvel[cell.gripper_dof])
        return Sensed(position, velocity, opening, speed, self.tick)

    def _state(self) -> tuple[Array, Array]:
        """Return joint positions and velocities, rad, rad/s, as they are. Valid until the next call."""
        position, velocity = self._true
        np.take(self._data.qpos, self._cell.qpos, out=position)
        np.take(self._data.qvel, self._cell.dof, out=velocity)
        return position, velocity

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Open the brakes and give torques and gripper force for the coming torque cycle.

        What is no number, or beyond the torque limits, is never given: the brakes close, and it is returned.
        """
        if math.isfinite(grip_force) and self._cell.gripper_actuator is not None:
            self.grip_force = grip_force
        wrong = self._wrong(torque)
        if wrong is not None:
            self.clipped += 1
            self.brake()
            return wrong
        self.waited = 0
        self._brake.open()
        np.copyto(self._command, torque)
        self._give()
        return None

    def brake(self) -> None:
        """Close the brakes; the motors give nothing, the gripper keeps its force."""
        self._brake.close(self._state()[0])
        self._give()

    def weaken(self, most: Array | None) -> None:
        """Let the motors give no more than `most` (joints,), N m, from the next command on; None: they are sound."""
        self._most = most

    def step(self, ticks: int) -> None:
        """Simulate `ticks` ticks. After a fault the arm stands still in its last sound state; time goes on."""
        self._contacts.struck = None
        for _ in range(ticks):
            if self.waited >= self._patience:
                self._brake.close(self._state()[0])
            if not self._given:
                self._give()
            self._given = False
            self.waited += 1
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
        state.violations, state.pushed, state.struck = self.violations, self.pushed, self._struck
        state.waited, state.braked, state.rest = self.waited, self.braked, self._brake.rest

    def restore(self, state: Message) -> None:
        """Go on, bit for bit, from an `ARM_STATE`; its last torques are the last command."""
        d, cell = self._data, self._cell
        mujoco.mj_setState(self._model, d, state.state, STATE)
        self.tick, self.clipped, self._contacts.count = state.tick, state.clipped, state.touches
        self._limits.count, self._limits.pushed, self._struck = state.violations, state.pushed, state.struck
        self._brake.closed, self.waited = bool(state.braked), state.waited
        np.copyto(self._brake.rest, state.rest)
        np.take(d.ctrl, cell.actuators, out=self._command)
        np.copyto(self.torque, self._command)
        self.grip_force = float(d.ctrl[cell.gripper_actuator]) if cell.gripper_actuator is not None else 0.0
        self._given = True

    @property
    def _now_s(self) -> float:
        return self.tick * self._clock_ns * 1e-9

    def _wrong(self, torque: Array) -> Finding | None:
        """Return what is wrong with a command that no servo level gives."""
        if np.count_nonzero(np.abs(torque) <= self._farthest) == torque.size:
            return None
        if np.isfinite(torque).all():
            joint = int((np.abs(torque) / self._farthest).argmax())
            return Finding(Alarm.COMMAND_LIMIT, joint, float(torque[joint]))
        return Finding(Alarm.COMMAND_INVALID, int((~np.isfinite(torque)).argmax()))

    def _give(self) -> None:
        """Pass the command to the motors, or the brakes' torque to the joints, through the limit gate."""
        d, cell = self._data, self._cell
        q, qd = self._state()
        closed = self._brake.closed
        passed, cut = self._gate.admit(self._brake.torque(q, qd) if closed else self._command, q, qd)
        self.clipped += cut
        d.qfrc_applied[cell.dof] = passed if closed else 0.0
        np.copyto(self.torque, 0.0 if closed else passed)
        d.ctrl[cell.actuators] = self.torque if self._most is None else np.clip(self.torque, -self._most, self._most)
        if cell.gripper_actuator is not None:
            d.ctrl[cell.gripper_actuator] = self.grip_force
        self._given = True

    def _simulate(self) -> None:
        """Simulate one tick; if that ends in a fault, the state before it stays."""
        m, d = self._model, self._data
        mujoco.mj_getState(m, d, self._sound, STATE)
        for mocap, motion in self._motions:
            d.mocap_pos[mocap] = motion.position(self._now_s)
        touches = self._contacts.count
        for substep in range(self._substeps):
            mujoco.mj_step(m, d)
            self._contacts.look(d, d.time)
            self._limits.look(substep)
        if self._contacts.count > touches and self._contacts.struck is not None:
            self._struck = STRUCK_TICKS
        broken = self._limits.judge(self._now_s, self._struck > 0)
        if self._struck:
            self._struck = STRUCK_TICKS if broken else self._struck - 1
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
