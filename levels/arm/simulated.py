"""The arm and its cell in MuJoCo, with drives that keep the limits by themselves."""

from __future__ import annotations

import math
from collections import deque

import mujoco
import numpy as np

from rack.levels.algebra import Array, mat_vec
from rack.levels.arm.arm import Arm
from rack.levels.arm.drives import LimitGate, SetPointGate
from rack.levels.arm.link import JointTarget, Sensed, copy_sample
from rack.levels.arm.sensors import CoarseSensors, WristSensor
from rack.levels.arm.simulation import Simulation
from rack.levels.level import Finding
from rack.levels.messages import ArmState
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.model import SET_POINT_ROWS
from rack.levels.tables import SceneConfig, SensorConfig

STANDSTILL = 0.01
"""Joint speed in rad/s below which the brakes hold a joint at its position."""
BRAKE_BANDWIDTH = 20.0
"""Bandwidth of the position hold by the brakes, in rad/s."""
POSITION_GAIN = 25.0
VELOCITY_GAIN = 100.0
INTEGRAL_GAIN = 10.0
"""Gains of a simulated drive, 1/s.

They are speed per position error, acceleration per velocity error, and the integral gain. Each loop
is at least twice as fast as the loop around it, and all are slow compared with ticks of 2.5 ms.
"""


class SimulatedArm(Simulation, Arm):
    """An `Arm` simulated with MuJoCo, in `substeps` steps per tick.

    Simulated time is always the tick number times the duration of a tick. Samples have the
    resolution and noise of the cell's encoders. Brakes and limit gate are part of the drives and
    use the true state. A command applies for one torque cycle. The torques pass the limit gate in
    every tick, even while the servo level misses cycles. Drives that follow set points (`[robot]
    interface`) compute a new torque in every tick. The state of these drives is in MuJoCo's user
    data.
    """

    keeps_limits = is_simulated = True
    sensors = SensorConfig()

    def __init__(
        self, cell: Cell, scene: SceneConfig, clock_ns: int, every: int = 1, seed: int = 0
    ) -> None:
        super().__init__(cell, scene, clock_ns, every, seed)
        d = self._data
        joints = len(cell.qpos)
        self.prepare_simulation(scene, clock_ns)
        self._gripper = cell.gripper
        dynamics = self.dynamics
        tick_s = clock_ns * 1e-9
        self._gate = LimitGate(cell.bounds, cell.limits.acceleration, tick_s, dynamics)
        self._rest: Array = cell.begin.copy()  # (joints,), rad: held by the brakes
        self._weak_limits: Array | None = None  # (joints,), N m: limits of weakened motors
        self._coarse = None if cell.encoders.is_exact else CoarseSensors(cell.encoders, seed)
        self._latency = cell.encoders.latency_ticks
        # Samples that are delayed by the latency, oldest first.
        self._samples: deque[Sensed] = deque(maxlen=self._latency + 1)
        self._wrist = None if cell.wrist is None else WristSensor(cell.wrist, d, seed)
        # (joints,), N m: the last command, and the torque applied for it.
        self._command, self.torque = np.zeros((2, joints))
        self._has_passed_gate = False  # True if the command for the coming tick has passed the gate
        self._drives: CascadedDrives | None = None  # None if drives take torques
        if cell.interface != "torque":
            rows = d.userdata[-SET_POINT_ROWS * joints :].reshape(SET_POINT_ROWS, joints)
            self._drives = CascadedDrives(cell, dynamics, tick_s, every, rows)
            self._set_points = SetPointGate(self, cell.bounds, tick_s, rows[:2])
            self.reports_torque = every == 1
        # Until the first step, the wrist sensor must sense a braked arm, not a falling one.
        if self._wrist is not None:
            self._apply_command()
            mujoco.mj_forward(cell.model, d)

    @property
    def is_holding_object(self) -> bool:
        """True if the gripper touches an object."""
        return bool(self._mark_held_geoms().any())

    @property
    def is_touching_surroundings(self) -> bool:
        """True if the arm, or its load, touches anything else."""
        contact = self._data.contact
        one_sided = self._mark_own_geoms()[contact.geom].sum(axis=1) == 1
        return bool((one_sided & (contact.dist < 0.0)).any())

    def sense(self) -> Sensed:
        """Return the newest sample of the joints and the gripper."""
        return self._samples[0] if self._samples else self._build_sample()

    def _build_sample(self) -> Sensed:
        """Return a sample of the present state, including the errors of the encoders."""
        position, velocity = self._state
        if self._coarse is not None:
            position, velocity = self._coarse.sample(position, velocity, self.tick)
        if (offset := self.cell.encoders.offset) is not None:
            position = position - offset
        gripper = self._gripper
        if gripper is None:
            return Sensed(position, velocity, 0.0, 0.0, self.tick)
        opening = float(self._data.qpos[gripper.linkage.driven])
        speed = float(self._data.qvel[gripper.dof])
        return Sensed(position, velocity, opening, speed, self.tick)

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Release the brakes and apply torques and gripper force for the coming torque cycle.

        See `Link.drive`.
        """
        self._apply_grip_force(grip_force)
        finding = self.refused(torque)
        if finding is None:
            self._command[:] = torque
            self._release_brakes()
        else:
            self.brake()
        return finding

    def follow(self, target: JointTarget, grip_force: float) -> Finding | None:
        """Release the brakes and follow a set point for the coming cycle; see `Link.follow`."""
        self._apply_grip_force(grip_force)
        # The encoders and the model measure positions from different origins.
        if (offset := self.cell.encoders.offset) is not None:
            target = target._replace(position=target.position + offset)
        passed = self._set_points.limit_set_point(target, *self._state)
        if isinstance(passed, Finding):
            return passed
        if self.braked and self._drives is not None:
            self._drives.start(target.torque, *self._state)
        self._release_brakes()
        return None

    def _release_brakes(self) -> None:
        """Release the brakes, and apply the command to the motors."""
        self.waited = 0
        self.braked = False
        self._apply_command()

    def _apply_grip_force(self, force: float) -> None:
        """Set the force of the gripper in N. Ignore a force that is not finite."""
        if self._gripper is not None and math.isfinite(force):
            self._data.ctrl[self._gripper.actuator] = self.grip_force = force

    def brake(self) -> None:
        """Engage the brakes. The motors apply no torque, and the gripper keeps its force."""
        self._engage_brakes()
        self._apply_command()

    def _engage_brakes(self) -> None:
        """Engage the brakes, and store the positions that they hold."""
        if not self.braked:
            self.braked = True
            np.copyto(self._rest, self._state[0])

    def weaken(self, most: Array | None) -> None:
        """Limit the motor torques, beginning with the next command.

        `most` is the largest torque of each joint, (joints,), N m, or None for intact motors.
        """
        self._weak_limits = most

    def step(self, ticks: int) -> None:
        """Simulate `ticks` ticks.

        After a fault the arm stands still in its last valid state, while time continues.
        """
        self.contact = None
        for _ in range(ticks):
            if self.waited >= self.patience:
                self._engage_brakes()
            if not self._has_passed_gate:
                self._apply_command()
            self._has_passed_gate = False
            self.waited += 1
            if not self.fault:
                self._simulate_tick()
            self.tick += 1
            if self._latency:
                self._samples.append(copy_sample(self._build_sample()))
        self.report_braking()
        if self.fault:
            self._data.time = self._now_s

    def sense_wrist(self) -> Array | None:
        """Return the force in N and the torque in N m that the wrist sensor measures, (6,).

        The sample is one substep old, like all of MuJoCo's sensors.
        """
        return None if self._wrist is None else self._wrist.sample(self.tick)

    def save(self, state: ArmState) -> None:
        """Fill an `ArmState`, including the positions held by the brakes."""
        super().save(state)
        state.rest = self._rest

    def restore(self, state: ArmState) -> None:
        """Restore an `ArmState`, so that the simulation continues bit for bit.

        The torques in the state become the last command.
        """
        super().restore(state)
        d = self._data
        cell = self.cell
        np.copyto(self._rest, state.rest)
        np.take(d.ctrl, cell.actuators, out=self._command)
        np.copyto(self.torque, self._command)
        if self._gripper is not None:
            self.grip_force = float(d.ctrl[self._gripper.actuator])
        # Restored torques have passed the gate. Drives that follow a set point must compute a new
        # torque, unless the set point arrived in this tick.
        self._has_passed_gate = self._drives is None or self.braked or self.waited == 0

    def _apply_command(self) -> None:
        """Apply torques to the joints, cut by the limit gate.

        While the arm is braked, these are the torques of the brakes. Otherwise they are the
        commanded torques, or the torques with which the drives follow a set point.
        """
        cell = self.cell
        braked = self.braked
        q, qd = self._state
        if braked:
            torque = self._compute_braking_torque(q, qd)
        elif self._drives is None:
            torque = self._command
        else:
            torque = self._drives.compute_torque(q, qd, self.waited)
        passed, cut = self._gate.limit_torque(torque, q, qd)
        self.clipped += cut
        self._data.qfrc_applied[cell.dof] = passed if braked else 0.0
        np.copyto(self.torque, 0.0 if braked else passed)
        torque = self.torque
        if self._weak_limits is not None:
            torque = np.clip(torque, -self._weak_limits, self._weak_limits)
        self._data.ctrl[cell.actuators] = torque
        self._has_passed_gate = True

    def _compute_braking_torque(self, q: Array, qd: Array) -> Array:
        """Return the torques with which the brakes stop or hold the joints, (joints,), in N m.

        The brakes act even if the motors are off.
        """
        max_acceleration = self.cell.limits.acceleration
        np.copyto(self._rest, q, where=np.abs(qd) > STANDSTILL)
        wanted_acceleration = BRAKE_BANDWIDTH**2 * (self._rest - q) - 2.0 * BRAKE_BANDWIDTH * qd
        inertia, bias = self.dynamics.terms(q, qd)
        return np.asarray(
            mat_vec(inertia, np.clip(wanted_acceleration, -max_acceleration, max_acceleration))
            + bias
        )


class CascadedDrives:
    """Position servos with cascaded loops: P on position around PI on velocity, limited in torque.

    Like the controllers of such arms, they use the arm's present inertia. A constant inertia,
    computed at home, would suit arms with gears, but makes the K-1607, which has no gears,
    oscillate. Gravity, friction and load are compensated by the integral, which starts from the
    predicted torque when the brakes are released.
    """

    def __init__(
        self, cell: Cell, dynamics: Dynamics, tick_s: float, every: int, rows: Array
    ) -> None:
        """Prepare the drives.

        Args:
            cell: The arm.
            dynamics: Its equation of motion.
            tick_s: Duration of a tick, s.
            every: Length of a cycle, ticks.
            rows: State of the drives, (3, joints): position, rad, and velocity, rad/s, at the end
                of a cycle, and torque of the integral, N m.
        """
        self._rows = rows
        self._dynamics = dynamics
        self._tick_s = tick_s
        self._every = every
        self._limit = cell.bounds.torque
        self._position_gain = POSITION_GAIN if cell.interface == "position" else 0.0

    def start(self, torque: Array, q: Array, qd: Array) -> None:
        """Initialize the integral so that the drives continue without a step in torque.

        Args:
            torque: Predicted torque of the motion, (joints,), N m. Its share for acceleration is
                subtracted.
            q: Positions, (joints,), rad.
            qd: Velocities, (joints,), rad/s.
        """
        change = (self._rows[1] - qd) / (self._every * self._tick_s)
        self._rows[2] = torque - mat_vec(self._dynamics.terms(q, qd).inertia, change)

    def compute_torque(self, q: Array, qd: Array, waited: int) -> Array:
        """Return the torques of the coming tick, (joints,), in N m.

        Args:
            q: Positions at the start of the tick, (joints,), rad.
            qd: Velocities at the start of the tick, (joints,), rad/s.
            waited: Ticks since the set point arrived.
        """
        position, velocity, integral = self._rows
        target = position + (waited - self._every) * self._tick_s * velocity
        slip = velocity + self._position_gain * (target - q) - qd
        pull = VELOCITY_GAIN * mat_vec(self._dynamics.terms(q, qd).inertia, slip)
        wanted_torque = pull + integral
        torque = np.asarray(np.clip(wanted_torque, -self._limit, self._limit))
        # The integral stops while the torque is limited, to avoid windup.
        integral += np.where(torque == wanted_torque, INTEGRAL_GAIN * self._tick_s * pull, 0.0)
        return torque
