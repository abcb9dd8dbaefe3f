"""Judges what the sensors say, and knows where the arm is while they lie."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.arm import Sensed
from rack.levels.cell import Bounds
from rack.levels.level import Finding
from rack.levels.limits import Encoders

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROOM_RAD = 5e-5
"""What positions may differ from what velocities lead to: 20 times what faultless runs show, contacts included."""
BEYOND_RAD, BEYOND_SPEED = 0.05, 1.2
"""How far beyond its range, and at what multiple of its velocity limit, no joint can be."""
STILL_CYCLES = 10
"""Cycles without the least change, while the set point goes on, that no joint is capable of."""
STILL_RAD = 5e-5
"""Way of the set point in that time: however slow it is, a joint that is driven with a stuck sensor soon runs away."""
PLAUSIBLE_RAD = 1e-3
"""Offset of a joint that came with a fault of its sensor and is taken over at rest: a millimetre at the arm's reach."""
STUCK_RAD = 0.01
"""How far a joint may have come until it is noticed that its sensor does not tell."""
STUCK_STEPS = 3.0
"""Way, in multiples of what a good sample may be off both ways, after which an encoder that shows none is stuck."""
UNSEEN_S = 0.05
"""Time for which a joint may have moved off while its sensor, unnoticed, did not."""
BRAKE_TAIL_S2 = 1e-3
"""What a joint needs beyond v^2 / 2 a until the brake has stopped it, for every rad/s2 of its braking."""
STRUCK_SPEED = 5.0
"""Multiple of that velocity up to which a blow may throw a joint about, within a cycle and without any model."""
SILENT_CYCLES = 2
"""Cycles without a new sample after which the sensors are silent."""


class SensorMonitor:
    """Holds every sample against the one before: a position must be where the velocities lead to.

    `position`, `velocity` (joints,), rad, rad/s, are the sample's if it is good. Where it is not, they go on with the
    sensed velocity or, without one, as the brakes stop the arm; `doubt` (joints,), rad, is how far off that may be.
    A joint is good again where what it says fits to that, and from sample to sample to itself, `good_cycles` in a row:
    an offset that is greater than the doubt is never taken for the truth. `blamed`: joint, what it reads, rad, and by
    how much that is off, rad; -1 and the age, ticks, of a sample that does not come. `fresh`: there is a sample of this
    cycle. `faulty`: not yet `good_cycles` in a row were good, or `retry_cycles` where a joint that was stuck shows no
    change at rest. `drivable`: velocities are known, so the arm could still be driven.
    """

    def __init__(
        self,
        bounds: Bounds,
        encoders: Encoders,
        braking: Array,
        home: Array,
        tick_s: float,
        every: int,
        good_cycles: int,
        retry_cycles: int,
    ) -> None:
        """Judge joints that brake with `braking`, rad/s2, and start at `home`, rad, in cycles of `every` ticks."""
        self._retry_cycles = max(retry_cycles, good_cycles)
        self._room, self._speed_room = ROOM_RAD + 2.0 * encoders.off, encoders.speed_off
        self._coarse = not encoders.exact
        self._unshown = np.maximum(STILL_RAD, STUCK_STEPS * 2.0 * encoders.off)
        self._low, self._high = bounds.position[:, 0] - BEYOND_RAD, bounds.position[:, 1] + BEYOND_RAD
        self._fastest = BEYOND_SPEED * bounds.velocity
        self._braking, self._tick_s, self._every, self._good_cycles = braking, tick_s, every, good_cycles
        joints = len(home)
        self.position, self.velocity, self.doubt = home.copy(), np.zeros(joints), np.zeros(joints)
        self._raw = (home.copy(), np.zeros(joints))
        self._unchanged = np.zeros(joints, dtype=bool)
        self._still, self._still_way, self._claimed = np.zeros(joints, dtype=int), np.zeros(joints), np.zeros(joints)
        self._unproven = np.zeros(joints, dtype=bool)  # stuck, and without a change since
        self._suspect, self._everyone = np.zeros(joints, dtype=bool), np.ones(joints, dtype=bool)
        self._sent = self._everyone  # its set point moves, or may have moved
        self._tick: int | None = None
        self._streak = 0
        self._rung: set[Alarm] = set()
        self.findings: list[Finding] = []
        self.blamed = (-1, 0.0, 0.0)
        self.fresh = self.drivable = True
        self.faulty = False

    def recall(self, state: Message) -> None:
        """Go on from what an `ARM_STATE` says that the level knew."""
        self.position[:], self.velocity[:], self.doubt[:] = state.position, state.velocity, state.doubt
        self._tick = state.tick

    def remember(self, state: Message) -> None:
        """Fill in what `recall` wants to know."""
        state.position, state.velocity, state.doubt = self.position, self.velocity, self.doubt

    def look(self, sensed: Sensed, tick: int, wanted: Array | None, struck: bool = False) -> None:
        """Judge a sample at `tick`; `wanted`: velocities, rad/s, that the arm was driven with, None: it was not.

        `struck`: something has touched the arm since the last cycle.

        What is wrong is added to `findings`, once an episode.
        """
        passed = tick - self._tick if self._tick is not None else self._every
        self._tick, passed_s = tick, passed * self._tick_s
        self.fresh = sensed.tick == tick
        if not self.fresh:
            self._go_on_blind(passed_s, tick - sensed.tick)
            return
        q, qd = sensed.position, sensed.velocity
        change = qd - self.velocity
        way = (0.5 * passed_s) * (qd + self.velocity)
        room = self._room + passed_s * (np.abs(change) + self._speed_room)
        if passed > self._every:
            # Driven on for a while, then braked: faster in between than at both ends.
            room += passed_s * 4.0 * self._every * self._tick_s * self._braking
        fastest = self._fastest
        if struck:
            fastest = STRUCK_SPEED * fastest
            room += passed_s * fastest
        # Never true for what is no number.
        fits = np.abs(q - self.position - way) <= (room + self.doubt if self.faulty else room)
        stirs = self._stirs(q, qd, change, wanted, passed_s)
        if self._coarse:
            # Exact sensors that do not change show it in the next sample.
            self._claim(q, qd, passed_s)
            stirs = stirs and bool((self._claimed <= self._room).all())
        if self.faulty or not stirs or np.count_nonzero(fits) < fits.size:
            self._sent = self._everyone if wanted is None else wanted != 0.0
            self._doubtful(q, qd, way, fits & (np.abs(qd) <= fastest), room, passed_s)
            return
        self._take(q, qd, way, room)

    def _take(self, q: Array, qd: Array, way: Array, room: Array) -> None:
        """Trust a sample; say where that moves a joint by more than `room`, rad."""
        np.equal(q, self._raw[0], out=self._unchanged)
        if np.count_nonzero(self.doubt):
            off = q - self.position - way
            for joint in np.flatnonzero(np.abs(off) > room):
                self.findings.append(Finding(Alarm.RE_REFERENCED, int(joint), float(off[joint])))
            # What does not change proves nothing: it may be stuck.
            self.doubt[~self._unchanged] = 0.0
        np.copyto(self.position, q)
        np.copyto(self.velocity, qd)
        np.copyto(self._raw[0], q)
        np.copyto(self._raw[1], qd)

    def _stirs(self, q: Array, qd: Array, change: Array, wanted: Array | None, passed_s: float) -> bool:
        """Say whether no joint has been still for too long while it was under way."""
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
        """Add up where a sensor says that a joint is going while it shows no change: at the least that it may be."""
        self._claimed += passed_s * np.maximum(np.abs(qd) - self._speed_room, 0.0)
        self._claimed *= (q == self._raw[0]) & (qd == self._raw[1])

    def _is_still(self) -> Mask:
        return np.asarray((self._still >= STILL_CYCLES) & (np.abs(self._still_way) >= self._unshown))

    def _doubtful(self, q: Array, qd: Array, way: Array, fits: Mask, room: Array, passed_s: float) -> None:
        """Name what is wrong with a sample, take what is right, and go on from what is known for the rest."""
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
            # One that showed no change may have been stuck while its joint crept: it is off by that now it shows one.
            np.maximum(self.doubt, np.where(self._unchanged, STUCK_RAD, PLAUSIBLE_RAD), out=self.doubt)
            # One that shows none now though its joint was sent somewhere may be stuck as well, since before that was
            # found.
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
        """Keep the joint that is wrong by most."""
        if not good.all():
            amount = np.where(np.isfinite(off), np.abs(off), np.inf)
            joint = int(np.where(good, -1.0, amount).argmax())
            self.blamed = joint, float(q[joint]), float(off[joint])

    def _estimate(self, q: Array, qd: Array, way: Array, known: Mask, passed_s: float) -> None:
        """Let suspects go on, with their velocity where that is known; take the others as sensed.

        A sample of a suspect that happens to fit is not taken: noise would lead the estimate away step by step.
        """
        coasting = self._suspect & known
        self.doubt[coasting] += 0.5 * passed_s * np.abs(qd - self.velocity)[coasting]
        self._brake(self._suspect & ~known, passed_s)
        np.copyto(self.position, q, where=~self._suspect)
        np.add(self.position, way, out=self.position, where=coasting)
        np.copyto(self.velocity, qd, where=known)

    def _go_on_blind(self, passed_s: float, age: int) -> None:
        """Go on without a sample."""
        if age >= SILENT_CYCLES * self._every:
            self._ring(Finding(Alarm.SENSOR_SILENT, -1, age))
            self.drivable = False
            self._suspect[:] = True
            self.blamed = -1, float(age), 0.0
        self._streak = 0
        self._brake(self._everyone, passed_s)

    def _brake(self, joints: Mask, passed_s: float) -> None:
        """Let joints go on as the brakes stop them."""
        if not joints.any():
            return
        speed = np.abs(self.velocity)
        time_s = np.minimum(passed_s, speed / self._braking)
        way = (speed - 0.5 * self._braking * time_s) * time_s * joints
        # Until the brakes close the last torque still acts.
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
        """Count good samples in a row; say whether there are enough of them to end the episode."""
        self._streak = self._streak + 1 if good else 0
        if self._streak < (self._retry_cycles if self._unproven.any() else self._good_cycles):
            return False
        self.faulty, self._streak = False, 0
        self._unproven[:] = False
        self._suspect[:] = False
        self._rung.clear()
        return True
