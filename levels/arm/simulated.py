"""The arm and its cell in MuJoCo, with drives that keep the limits by themselves."""

from __future__ import annotations

import math
from collections import deque

import mujoco
import numpy as np

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.arm.arm import Arm, JointTarget, Sensed, copied
from rack.levels.arm.drives import Brake, CoarseSensors, LimitGate, give
from rack.levels.arm.set_points import CascadedDrives, SetPointGate
from rack.levels.arm.simulation import Simulation
from rack.levels.arm.wrist import WristSensor
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.engine import one_view
from rack.levels.robot.model import SET_POINT_ROWS
from rack.levels.tables import SceneConfig, SensorConfig


class SimulatedArm(Simulation, Arm):
    """Implements `Arm`: `substeps` MuJoCo steps a tick; simulated time is tick times period,
    always.

    Samples are as coarse and noisy as the cell's encoders; brakes and limit gate belong to the
    drives and see the truth. A command is for one torque cycle. It passes the limit gate in every
    tick, even in those that the servo level missed. Drives that follow set points
    (`[robot] interface`) make a new torque in every tick; their state is in MuJoCo's user data.
    """

    keeps_limits = True
    sensors = SensorConfig()

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        d = self._data
        joints = len(cell.qpos)
        self.begin(scene, clock_ns)
        # Memory views: single numbers in a third of the time that arrays take.
        self._qpos: memoryview[float] = memoryview(d.qpos)
        self._qvel: memoryview[float] = memoryview(d.qvel)
        self._ctrl: memoryview[float] = memoryview(d.ctrl)
        self._gripper = cell.gripper
        dynamics = Dynamics(cell)
        self._gate = LimitGate(cell.bounds, cell.limits.acceleration, clock_ns * 1e-9, dynamics)
        self._brake = Brake(cell.limits.acceleration, dynamics, cell.begin)
        self._most: Array | None = None  # (joints,), N m: torques of weakened motors
        self._coarse = None if cell.encoders.exact else CoarseSensors(cell.encoders, seed)
        self._latency = cell.encoders.latency_ticks
        # The newest, oldest first: all that are on their way.
        self._samples: deque[Sensed] = deque(maxlen=self._latency + 1)
        self._wrist = None if cell.wrist is None else WristSensor(cell.wrist, d, seed)
        # N m: the newest command, the one in force, and its torque as given.
        self._asked, self._command, self.torque = torques = np.zeros((3, joints))
        self._given = False  # the command for the coming tick has passed the gate
        memory, (qpos, qvel, ctrl, brakes) = one_view(d.qpos, d.qvel, d.ctrl, d.qfrc_applied)
        places = np.stack(
            (qpos + cell.qpos, qvel + cell.dof, ctrl + cell.actuators, brakes + cell.dof)
        )
        self._drives: CascadedDrives | None = None  # None: they take torques
        if cell.interface != "torque":
            tick_s = clock_ns * 1e-9
            rows = d.userdata[-SET_POINT_ROWS * joints :].reshape(SET_POINT_ROWS, joints)
            self._drives = CascadedDrives(cell, dynamics, tick_s, every, rows)
            span_s = self.patience * tick_s
            self._set_points = SetPointGate(self, cell.bounds, tick_s, span_s, rows[:2])
            self.reports_torque = every == 1
        self._clear = torques, self.dynamics.newest, *self._gate.clearance, places, memory
        self._give_clear = give.load()
        if (
            self._wrist is not None
        ):  # until the first step it senses an arm that is braked, not one that falls
            self._give()
            mujoco.mj_forward(cell.model, d)

    @property
    def holds(self) -> bool:
        """Whether the gripper touches a part."""
        return self._contacts.holds(self._data)

    @property
    def leans(self) -> bool:
        """Whether the arm, or its load, touches anything else."""
        return self._contacts.leans(self._data)

    def sense(self) -> Sensed:
        """Return joint positions and velocities, rad, rad/s, and the gripper's, m, m/s."""
        return self._samples[0] if self._samples else self._sampled()

    def _sampled(self) -> Sensed:
        position, velocity = self._state
        if self._coarse is not None:
            position, velocity = self._coarse.sample(position, velocity, self.tick)
        if (offset := self.cell.encoders.offset) is not None:
            position = position - offset
        gripper = self._gripper
        if gripper is None:
            return Sensed(position, velocity, 0.0, 0.0, self.tick)
        opening = self._qpos[gripper.linkage.driven]
        return Sensed(position, velocity, opening, self._qvel[gripper.dof], self.tick)

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and give torques and gripper force for the coming torque cycle; see
        `Link.drive`."""
        self._asked[:] = torque
        if self._gripper is not None and math.isfinite(grip_force):
            self._ctrl[self._gripper.actuator] = self.grip_force = grip_force
        if self._most is None and self._give_clear(*self._clear):
            self.waited = 0
            self.braked = False
            self._given = True
            return None
        finding = self.refused(torque)
        if finding is not None:
            self.brake()
            return finding
        self.waited = 0
        self.braked = False
        self._command[:] = torque
        self._give()
        return None

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Release the brakes and follow, for the coming cycle; see `Link.follow`."""
        if self._gripper is not None and math.isfinite(grip_force):
            self._ctrl[self._gripper.actuator] = self.grip_force = grip_force
        if (offset := self.cell.encoders.offset) is not None:  # its encoders count from elsewhere
            target = target._replace(position=target.position + offset)
        passed = self._set_points.admit(target, *self._state)
        if isinstance(passed, Finding):
            return passed
        if self.braked and self._drives is not None:
            self._drives.start(target.torque, *self._state)
        self.waited = 0
        self.braked = False
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
        """Limit the motors to `most` (joints,), N m, from the next command on; None: they are
        sound."""
        self._most = most

    def step(self, ticks: int) -> None:
        """Simulate `ticks` ticks. After a fault the arm stands still in its last sound state; time
        continues."""
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
            if self._latency:
                self._samples.append(copied(self._sampled()))
        self.report_waiting()
        if self.fault:
            self._data.time = self._now_s

    def feel(self) -> Array | None:
        """Return the sample of the wrist sensor, (6,), N, N m: that of a substep ago, as MuJoCo's
        are."""
        return None if self._wrist is None else self._wrist.sample(self.tick)

    def save(self, state: Message) -> None:
        """Fill an `ARM_STATE`."""
        before = self._saved
        super().save(state)
        if self.braked or self._saved is not before:
            state.rest = self._brake.rest

    def restore(self, state: Message) -> None:
        """Continue, bit for bit, from an `ARM_STATE`; its last torques are the last command."""
        super().restore(state)
        d = self._data
        cell = self.cell
        np.copyto(self._brake.rest, state.rest)
        np.take(d.ctrl, cell.actuators, out=self._command)
        np.copyto(self.torque, self._command)
        self.grip_force = 0.0 if self._gripper is None else self._ctrl[self._gripper.actuator]
        # Torques stay; of a set point that came before the last tick, drives make a new one.
        self._given = self._drives is None or self.braked or self.waited == 0

    def _give(self) -> None:
        """Apply the command to the motors, or the brakes' torque to the joints, through the limit
        gate."""
        cell = self.cell
        braked = self.braked
        q, qd = self._state
        if braked:
            torque = self._brake.torque(q, qd)
        elif self._drives is None:
            torque = self._command
        else:
            torque = self._drives.torque(q, qd, self.waited)
        passed, cut = self._gate.admit(torque, q, qd)
        self.clipped += cut
        self._data.qfrc_applied[cell.dof] = passed if braked else 0.0
        np.copyto(self.torque, 0.0 if braked else passed)
        given = self.torque if self._most is None else np.clip(self.torque, -self._most, self._most)
        self._data.ctrl[cell.actuators] = given
        self._given = True
