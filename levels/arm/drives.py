"""Parts of the simulated arm's drives: brakes, the limit gate on torques, and encoders of finite
resolution."""

from __future__ import annotations

import math

import daqp
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array, cholesky_solve, mat_vec, solve
from rack.levels.compiled import compiled, compiled_for
from rack.levels.robot.dynamics import BIAS_ROW, FRICTION_SPEED, INERTIA_ROW, STATE_ROWS, Dynamics
from rack.levels.robot.limits import EDGE_TIMING_S, Bounds, Encoders

STANDSTILL = 0.01
"""Joint speed, rad/s, below which a joint holds its position."""
SPEED_PART = 0.99
"""Part of a velocity limit that the gate lets a joint reach; the rest covers model errors within a
cycle."""
RANGE_KEPT_RAD = 0.002
"""Distance that the gate keeps from the ends of a joint's range, for the same reason."""
CLEAR_PART = 0.01
"""Part of a velocity limit that must be left where one rough prediction is enough."""
HARD = 0
SOFT = 8
"""Kinds of the solver's constraints."""


class Brake:
    """Stops the joints and holds them where they came to rest, even with the motors off."""

    def __init__(
        self, braking: Array, dynamics: Dynamics, rest: Array, stiffness: float = 20.0
    ) -> None:
        """Stop with at most `braking` (joints,), rad/s2; `stiffness`, rad/s, is the bandwidth of
        the hold."""
        self._braking = braking
        self._dynamics = dynamics
        self._stiffness = stiffness
        self.rest: Array = rest.copy()  # (joints,), rad: where the joints came to rest

    def hold_at(self, q: Array) -> None:
        """Engage at positions `q`, (joints,), rad."""
        np.copyto(self.rest, q)

    def torque(self, q: Array, qd: Array) -> Array:
        """Return the torques (joints,), N m, that stop or hold the arm at state `q`, `qd`."""
        np.copyto(self.rest, q, where=np.abs(qd) > STANDSTILL)
        wanted = self._stiffness**2 * (self.rest - q) - 2.0 * self._stiffness * qd
        inertia, bias = self._dynamics.terms(q, qd)
        return np.asarray(mat_vec(inertia, np.clip(wanted, -self._braking, self._braking)) + bias)


class LimitGate:
    """Cuts torques so that the next cycle ends within limits, at a state from which the arm can
    still be stopped.

    A joint may be only so fast that it can brake, with `braking` (joints,), rad/s2, before the end
    of its range. The arm's equation of motion predicts the velocities. Torques that lead too far
    are replaced by the nearest ones, in acceleration, that do not: a small quadratic program, in
    which torque limits take precedence. Far from all limits, nearly always, one rough prediction
    shows that nothing is to be cut.
    """

    def __init__(self, bounds: Bounds, braking: Array, period_s: float, dynamics: Dynamics) -> None:
        self._torque = bounds.torque
        self._fastest = SPEED_PART * bounds.velocity
        self._low = bounds.position[:, 0] + RANGE_KEPT_RAD
        self._high = bounds.position[:, 1] - RANGE_KEPT_RAD
        self._braking = braking
        self._period_s = period_s
        self._dynamics = dynamics
        limits = np.stack(
            (self._torque, self._fastest, self._low, self._high, braking, dynamics.dry)
        )
        self.clearance = limits, period_s  # for `is_clear`
        self._is_clear = is_clear.load()
        joints = len(braking)
        self._inertia = np.eye(joints)
        self._resisting = np.zeros(joints)
        self._unity = np.eye(joints)
        self._kinds = np.repeat(np.array([SOFT, HARD], dtype=np.int32), joints)

    def admit(self, torque: Array, q: Array, qd: Array) -> tuple[Array, bool]:
        """Return the torques (joints,), N m, that may pass at state `q`, `qd`, and whether anything
        was cut.

        `torque` must be finite.
        """
        self._dynamics.terms(q, qd)
        if self._is_clear(torque, self._dynamics.newest, *self.clearance):
            return torque, False
        passed: Array = np.clip(torque, -self._torque, self._torque)
        least = -self._speed_towards(q - self._low, -qd) - qd
        most = self._speed_towards(self._high - q, qd) - qd
        gain = np.clip(self._gain(passed, q, qd), least, most)
        # Light joints change speed so much within a cycle that only its middle predicts where it
        # ends.
        gain = self._gain(passed, q + 0.5 * self._period_s * qd, qd + 0.5 * gain)
        if (gain < least).any() or (gain > most).any():
            passed = self._nearest(gain, least, most)
        return passed, not np.array_equal(passed, torque)

    def _gain(self, torque: Array, q: Array, qd: Array) -> Array:
        """Return the change in velocity, rad/s, that torques cause in one cycle at state `q`,
        `qd`."""
        self._inertia, bias = self._dynamics.terms(q, qd)
        self._resisting = bias + self._dynamics.friction(qd)
        return np.asarray(solve(self._inertia, torque - self._resisting) * self._period_s)

    def _nearest(self, gain: Array, least: Array, most: Array) -> Array:
        """Return the torques whose gain in velocity, rad/s a cycle, is nearest to `gain` between
        `least` and `most`."""
        scale = self._fastest
        per_torque = self._inertia * (scale / self._period_s) / self._torque[:, None]
        offset = self._resisting / self._torque
        upper = np.concatenate((most / scale, 1.0 - offset))
        lower = np.concatenate((least / scale, -1.0 - offset))
        nearest, _, status, _ = daqp.solve(
            self._unity, -gain / scale, per_torque, upper, lower, self._kinds
        )
        if status < 0:
            nearest = np.clip(gain, least, most) / scale
        return np.asarray(
            np.clip(
                (mat_vec(per_torque, nearest) + offset) * self._torque, -self._torque, self._torque
            )
        )

    def _speed_towards(self, distance: Array, speed: Array) -> Array:
        return speed_towards(distance, speed, self._fastest, self._braking, self._period_s)


@compiled_for("f8[::1], f8[:,::1], f8[:,::1], f8")
def is_clear(
    torque: Array,
    evaluation: Array,  # of the equation of motion: (3 + joints, joints)
    # (6, joints): torque, speed, low and high end of the range, braking, dry friction
    limits: Array,
    period_s: float,
) -> bool:
    """Return whether `torque` leads nowhere near a limit, by the equation of motion at the state of
    `evaluation`.

    It does not if the velocity stays within its bounds at no gain as at twice the gain predicted,
    with some room: more than inertia and bias change in a cycle.
    """
    q = evaluation[0]
    qd = evaluation[1]
    bias = evaluation[BIAS_ROW]
    inertia = evaluation[INERTIA_ROW:]
    most_torque, fastest, low, high, braking, dry = limits
    left = torque - bias
    for joint in range(len(q)):
        if not abs(torque[joint]) <= most_torque[joint]:
            return False
        left[joint] -= dry[joint] * math.tanh(qd[joint] / FRICTION_SPEED)
    twice = cholesky_solve(inertia, left) * (2.0 * period_s)
    for joint in range(len(q)):
        speed = fastest[joint]
        hard = braking[joint]
        room = CLEAR_PART * fastest[joint]
        least = (
            -speed_towards(q[joint] - low[joint], -qd[joint], speed, hard, period_s)
            - qd[joint]
            + room
        )
        most = (
            speed_towards(high[joint] - q[joint], qd[joint], speed, hard, period_s)
            - qd[joint]
            - room
        )
        if not (least <= 0.0 <= most and least <= twice[joint] <= most):
            return False
    return True


@compiled_for("f8[:,::1], f8[:,::1], f8[:,::1], f8, i8[:,::1], f8[::1]")
def give(
    torques: Array,  # (3, joints), N m: asked for, as commanded, as given
    evaluation: Array,  # this and the next two as for `is_clear`, evaluated at any state
    limits: Array,
    period_s: float,
    places: NDArray[np.int64],  # (4, joints), in the next: of position, velocity, motor, brake
    memory: Array,
) -> bool:
    """Give the torque asked for to the motors, and none to the brakes, if it is clear; return
    whether it is.

    The usual case in one call: the equation of motion has been evaluated, for the controller, at
    the arm's state.
    """
    for row in range(STATE_ROWS):
        for joint in range(torques.shape[1]):
            if evaluation[row, joint] != memory[places[row, joint]]:
                return False
    if not is_clear(torques[0], evaluation, limits, period_s):
        return False
    for joint in range(torques.shape[1]):
        torques[1, joint] = torques[2, joint] = memory[places[2, joint]] = torques[0, joint]
        memory[places[3, joint]] = 0.0
    return True


@compiled
def speed_towards(
    distance: Array, speed: Array, fastest: Array, braking: Array, period_s: float
) -> Array:
    """Return the highest speed, at the end of the cycle, towards an end of the range that is
    `distance` away.

    With v' at the end of the cycle the joint has come (v + v') T / 2 nearer, and must stop within
    the rest: v'^2 / 2 a <= distance - (v + v') T / 2.
    """
    half = 0.5 * braking * period_s
    left = np.maximum(distance - 0.5 * speed * period_s, 0.0)
    stoppable = np.sqrt(half * half + 2.0 * braking * left) - half
    return np.minimum(stoppable, fastest)


class CoarseSensors:
    """Samples positions and velocities of the joints: noise on the truth, then the nearest step of
    the encoder.

    Velocities are the drive's, which times the encoder's edges: as coarse, and as noisy, as
    positions over `EDGE_TIMING_S`. The noise of a tick is always the same, even on a restarted
    board or when sampled twice.
    """

    def __init__(self, encoders: Encoders, seed: int) -> None:
        per_second = np.array([[1.0], [1.0 / EDGE_TIMING_S]])
        self._sensors = seed, encoders.noise * per_second, encoders.resolution * per_second
        self._sense = sense_coarsely.load()

    def sample(self, position: Array, velocity: Array, tick: int) -> Array:
        """Return (2, joints): positions, rad, and velocities, rad/s, of a tick as sensed."""
        sample = np.array((position, velocity))
        self._sense(sample, tick, *self._sensors)
        return sample


@compiled_for("f8[:,::1], i8, i8, f8[:,::1], f8[:,::1]")
def sense_coarsely(sample: Array, tick: int, seed: int, noise: Array, step: Array) -> None:
    """Add noise to a true `sample` (2, joints), of standard deviation `noise`, and round it to
    multiples of `step`."""
    joints = sample.shape[1]
    chance = uniform(seed, tick, 2 * joints)
    for joint in range(joints):
        # Box and Muller: two independent normal numbers from two uniform ones.
        length = math.sqrt(-2.0 * math.log(chance[joint]))
        angle = 2.0 * math.pi * chance[joints + joint]
        sample[0, joint] += noise[0, joint] * length * math.cos(angle)
        sample[1, joint] += noise[1, joint] * length * math.sin(angle)
        for row in range(2):
            if step[row, joint] > 0.0:
                sample[row, joint] = (
                    np.rint(sample[row, joint] / step[row, joint]) * step[row, joint]
                )


@compiled_for("i8, i8, i8")
def uniform(seed: int, tick: int, count: int) -> Array:
    """Return `count` random numbers between 0 and 1, neither included: a function of seed and tick
    alone."""
    bits = mixed(np.zeros(count, dtype=np.uint64) + np.uint64(seed))
    bits = mixed(mixed(bits + np.uint64(tick)) + np.arange(count).astype(np.uint64))
    return ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53


@compiled
def mixed(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return `bits` mixed as SplitMix64 does (Steele, Lea and Flood, OOPSLA 2014)."""
    bits = bits + np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))
