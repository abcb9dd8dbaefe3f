"""Checks the joints' sensors, and estimates where the arm is while they are wrong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.arm import Sensed
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell
from rack.levels.servo.control import ServoParams

Mask = NDArray[np.bool_]

FIT_RAD = 5e-5
"""Permitted difference between a position and the integrated velocities: 20 times that of faultless runs."""
BEYOND_RAD, BEYOND_SPEED = 0.05, 1.2
"""Distance beyond its range, rad, and multiple of its velocity limit, that no joint can reach."""
STILL_CYCLES = 10
"""Cycles without any change, while the set point moves, after which a sensor is stuck."""
STILL_RAD = 5e-5
"""Least distance that the set point moves in that time: even a slow joint soon runs away with a stuck sensor."""
PLAUSIBLE_RAD = 1e-3
"""Offset after a fault of a joint's sensor that is accepted at rest: a millimetre at the arm's reach."""
STUCK_RAD = 0.01
"""Distance that a joint may have moved before its stuck sensor is noticed."""
STUCK_STEPS = 3.0
"""Motion, in multiples of twice a good sample's largest error, after which an encoder that shows none is stuck."""
UNSEEN_S = 0.05
"""Time for which a joint may have accelerated while its stuck sensor was not yet noticed."""
BRAKE_TAIL_S2 = 1e-3
"""Braking distance of a joint beyond v^2 / 2 a, per rad/s2 of its braking."""
STRUCK_SPEED = 5.0
"""Multiple of the fastest velocity that a blow may give a joint within a cycle."""
SILENT_CYCLES = 2
"""Cycles without a new sample after which the sensors are silent."""


class SensorMonitor:
    """Checks every sample against the one before: positions must agree with the integrated velocities.

    A joint is good again when its samples agree with the estimate, and with each other, for `good_cycles` in a row: an
    offset greater than `doubt` is never accepted.
    """

    def __init__(self, cell: Cell, params: ServoParams, tick_s: float, every: int) -> None:
        """Check the joints of a cell in cycles of `every` ticks; they start at home."""
        self._good_cycles = params.good_cycles
        self._retry_cycles = max(round(params.retry / (every * tick_s)), params.good_cycles)
        encoders, bounds, home = cell.encoders, cell.bounds, cell.home
        self._room, self._speed_room = FIT_RAD + 2.0 * encoders.off, encoders.speed_off
        self._coarse = not encoders.exact
        self._unshown = np.maximum(STILL_RAD, STUCK_STEPS * 2.0 * encoders.off)
        self._low, self._high = bounds.position[:, 0] - BEYOND_RAD, bounds.position[:, 1] + BEYOND_RAD
        self._fastest = BEYOND_SPEED * bounds.velocity
        self._braking, self._tick_s, self._every = cell.limits.acceleration, tick_s, every
        joints = len(home)
        self.position = home.copy()  # (joints,), rad: as sensed; estimated for joints whose sensor is suspect
        self.velocity = np.zeros(joints)  # (joints,), rad/s, likewise; unknown ones are estimated as braked
        self.doubt = np.zeros(joints)  # (joints,), rad: largest error of `position`
        self.fresh = True  # there is a sample of this cycle
        self.faulty = False  # a sensor is, or was until fewer than `good_cycles` ago, at fault
        self.drivable = True  # velocities are known, so the arm could still be driven
        self.blamed = (-1, 0.0, 0.0)  # joint, its reading and error, rad; no sample: -1, age in ticks, 0
        self.findings: list[Finding] = []  # new ones, one per episode; the executor removes them
        self._raw = (home.copy(), np.zeros(joints))  # position and velocity of the last sample
        self._unchanged = np.zeros(joints, dtype=bool)  # the last sample trusted showed the position before it
        self._still = np.zeros(joints, dtype=int)  # cycles without a change while the set point moves
        self._still_way = np.zeros(joints)  # rad: motion of the set point in that time
        self._claimed = np.zeros(joints)  # rad: integrated sensed velocity while the sample does not change
        self._unproven = np.zeros(joints, dtype=bool)  # stuck, and without a change since
        self._suspect, self._everyone = np.zeros(joints, dtype=bool), np.ones(joints, dtype=bool)
        self._sent = self._everyone  # its set point moves, or may have moved
        self._tick: int | None = None
        self._streak = 0  # good samples in a row
        self._rung: set[Alarm] = set()  # alarms raised in this episode

    def recall(self, state: Message) -> None:
        """Continue from the estimate in an `ARM_STATE`."""
        self.position[:], self.velocity[:], self.doubt[:] = state.position, state.velocity, state.doubt
        self._tick = state.tick

    def remember(self, state: Message) -> None:
        """Fill in the estimate for `recall`."""
        state.position, state.velocity, state.doubt = self.position, self.velocity, self.doubt

    def look(self, sensed: Sensed, tick: int, wanted: Array | None, struck: bool = False) -> None:
        """Check a sample at `tick`, and add faults to `findings`, once per episode.

        `wanted` are the velocities, (joints,), rad/s, at which the arm was driven; None: it was not. `struck`:
        something has touched the arm since the last cycle.
        """
        passed = tick - self._tick if self._tick is not None else self._every
        self._tick, passed_s = tick, passed * self._tick_s
        self.fresh = sensed.tick == tick
        if not self.fresh:
            self._estimate_blind(passed_s, tick - sensed.tick)
            return
        q, qd = sensed.position, sensed.velocity
        change = qd - self.velocity
        way = (0.5 * passed_s) * (qd + self.velocity)
        room = self._room + passed_s * (np.abs(change) + self._speed_room)
        if passed > self._every:
            # Driven for a while, then braked: in between it was faster than at both ends.
            room += passed_s * 4.0 * self._every * self._tick_s * self._braking
        fastest = self._fastest
        if struck:
            fastest = STRUCK_SPEED * fastest
            room += passed_s * fastest
        # Never true for NaN.
        fits = np.abs(q - self.position - way) <= (room + self.doubt if self.faulty else room)
        stirs = self._stirs(q, qd, change, wanted, passed_s)
        if self._coarse:
            # An exact sensor that is stuck shows it in the next sample.
            self._claim(q, qd, passed_s)
            stirs = stirs and bool((self._claimed <= self._room).all())
        if self.faulty or not stirs or np.count_nonzero(fits) < fits.size:
            self._sent = self._everyone if wanted is None else wanted != 0.0
            self._doubtful(q, qd, way, fits & (np.abs(qd) <= fastest), room, passed_s)
            return
        self._take(q, qd, way, room)

    def _take(self, q: Array, qd: Array, way: Array, room: Array) -> None:
        """Trust a sample; report a joint that this moves by more than `room`, rad."""
        np.equal(q, self._raw[0], out=self._unchanged)
        if np.count_nonzero(self.doubt):
            off = q - self.position - way
            for joint in np.flatnonzero(np.abs(off) > room):
                self.findings.append(Finding(Alarm.RE_REFERENCED, int(joint), float(off[joint])))
            # A sensor that does not change proves nothing: it may be stuck.
            self.doubt[~self._unchanged] = 0.0
        np.copyto(self.position, q)
        np.copyto(self.velocity, qd)
        np.copyto(self._raw[0], q)
        np.copyto(self._raw[1], qd)

    def _stirs(self, q: Array, qd: Array, change: Array, wanted: Array | None, passed_s: float) -> bool:
        """Return whether every joint has moved, or its set point has not, in the last `STILL_CYCLES`."""
        if wanted is None or np.count_nonzero(change) == change.size:
            if np.count_nonzero(self._still):
                self._still[:] = 0
                self._still_way[:] = 0.0
            return True
        still = (change == 0.0) & (q == self._raw[0]) & (wanted != 0.0)
        self._still += 1
        self._still *= still
        self._still_way += passed_s * wanted
        self._still_way *= still
        return not self._is_still().any()

    def _claim(self, q: Array, qd: Array, passed_s: float) -> None:
        """Integrate the least motion that a joint's sensed velocity implies while its sample does not change."""
        self._claimed += passed_s * np.maximum(np.abs(qd) - self._speed_room, 0.0)
        self._claimed *= (q == self._raw[0]) & (qd == self._raw[1])

    def _is_still(self) -> Mask:
        return np.asarray((self._still >= STILL_CYCLES) & (np.abs(self._still_way) >= self._unshown))

    def _doubtful(self, q: Array, qd: Array, way: Array, fits: Mask, room: Array, passed_s: float) -> None:
        """Report the faults of a sample, take its good joints, and estimate the others."""
        finite, inside = np.isfinite(q) & np.isfinite(qd), (q >= self._low) & (q <= self._high)
        last_q, last_qd = self._raw
        unchanged = (q == last_q) & (qd == last_qd)
        if not self._coarse:
            self._claim(q, qd, passed_s)
        frozen = self._claimed > self._room
        still, begins = self._is_still(), not self.faulty
        room += passed_s * np.abs(qd - last_qd)
        steady = np.abs(q - last_q - (0.5 * passed_s) * (qd + last_qd)) <= room
        self._name(Alarm.SENSOR_RANGE, ~finite | ~inside, q)
        self._name(Alarm.SENSOR_STUCK, frozen | still, self._still)
        self._name(Alarm.SENSOR_MODEL, finite & ~fits & ~frozen, q - self.position - way)
        good = fits & steady & inside & ~still & ~frozen
        self.drivable = bool((np.isfinite(qd) & ~frozen & ~still).all())
        self.doubt[still] += STUCK_RAD
        self._unproven |= still
        self._unproven &= unchanged
        if begins:
            # A sensor that showed no change may have been stuck while its joint crept: it may be off by that distance.
            np.maximum(self.doubt, np.where(self._unchanged, STUCK_RAD, PLAUSIBLE_RAD), out=self.doubt)
            # One that shows no change now, although its joint was driven, may have been stuck for longer.
            unseen = (UNSEEN_S * UNSEEN_S + BRAKE_TAIL_S2) * self._braking + self._unshown
            np.maximum(self.doubt, unseen, out=self.doubt, where=unchanged & self._sent)
        self._still[still] = 0
        self._blame(good, q, q - self.position - way)
        self._suspect |= ~good
        if self._settled(bool(good.all())):
            self._take(q, qd, way, self._room)
            return
        np.copyto(self._raw[0], q)
        np.copyto(self._raw[1], qd)
        self._estimate(q, qd, way, np.isfinite(qd) & ~frozen, passed_s)

    def _blame(self, good: Mask, q: Array, off: Array) -> None:
        """Keep the joint with the largest error."""
        if not good.all():
            amount = np.where(np.isfinite(off), np.abs(off), np.inf)
            joint = int(np.where(good, -1.0, amount).argmax())
            self.blamed = joint, float(q[joint]), float(off[joint])

    def _estimate(self, q: Array, qd: Array, way: Array, known: Mask, passed_s: float) -> None:
        """Estimate suspect joints from their velocity, or as braked where that is unknown; take the others as sensed.

        A suspect's sample that happens to fit is not used: with noise the estimate would drift.
        """
        coasting = self._suspect & known
        self.doubt[coasting] += 0.5 * passed_s * np.abs(qd - self.velocity)[coasting]
        self._brake(self._suspect & ~known, passed_s)
        np.copyto(self.position, q, where=~self._suspect)
        np.add(self.position, way, out=self.position, where=coasting)
        np.copyto(self.velocity, qd, where=known)

    def _estimate_blind(self, passed_s: float, age: int) -> None:
        """Estimate the joints without a sample."""
        if age >= SILENT_CYCLES * self._every:
            self._ring(Finding(Alarm.SENSOR_SILENT, -1, age))
            self.drivable = False
            self._suspect[:] = True
            self.blamed = -1, float(age), 0.0
        self._streak = 0
        self._brake(self._everyone, passed_s)

    def _brake(self, joints: Mask, passed_s: float) -> None:
        """Estimate `joints` as the brakes stop them."""
        if not joints.any():
            return
        speed = np.abs(self.velocity)
        time_s = np.minimum(passed_s, speed / self._braking)
        way = (speed - 0.5 * self._braking * time_s) * time_s * joints
        # Until the brakes engage the last torque still acts.
        acting = 2.0 * self._braking * passed_s * self._every * self._tick_s
        self.position += np.copysign(way, self.velocity)
        np.maximum(self.doubt, BRAKE_TAIL_S2 * self._braking, out=self.doubt, where=joints)
        self.doubt += way + acting * joints * (speed > 0.0)
        slower = np.copysign(np.maximum(speed - self._braking * time_s, 0.0), self.velocity)
        np.copyto(self.velocity, slower, where=joints)

    def _name(self, alarm: Alarm, wrong: Mask, values: Array | NDArray[np.int_]) -> None:
        if wrong.any():
            joint = int(wrong.argmax())
            self._ring(Finding(alarm, joint, float(values[joint])))

    def _ring(self, finding: Finding) -> None:
        self.faulty, self._streak = True, 0
        if finding.alarm not in self._rung:
            self._rung.add(finding.alarm)
            self.findings.append(finding)

    def _settled(self, good: bool) -> bool:
        """Count good samples in a row; return whether they are enough to end the episode."""
        self._streak = self._streak + 1 if good else 0
        if self._streak < (self._retry_cycles if self._unproven.any() else self._good_cycles):
            return False
        self.faulty, self._streak = False, 0
        self._unproven[:] = False
        self._suspect[:] = False
        self._rung.clear()
        return True
