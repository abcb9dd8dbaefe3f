"""Checks the joints' sensors, and estimates where the arm is while they are wrong."""

from __future__ import annotations

import sys
from functools import partial
from typing import NamedTuple

import numpy as np

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, Ints, Mask
from rack.levels.arm import Sensed
from rack.levels.compiled import compiled_for
from rack.levels.level import Finding
from rack.levels.robot.cell import Cell
from rack.levels.servo.control import ArmParams

FIT_RAD = 5e-5
"""Permitted difference between a position and the integrated velocities: 20 times that of faultless
runs."""
BEYOND_RAD = 0.05
BEYOND_SPEED = 1.2
"""Distance beyond its range, rad, and multiple of its velocity limit, that no joint can reach."""
STILL_CYCLES = 10
"""Cycles without any change, while the set point moves, after which a sensor is stuck."""
STILL_RAD = 5e-5
"""Least distance that the set point moves in that time: even a slow joint soon runs away with a
stuck sensor."""
PLAUSIBLE_RAD = 1e-3
"""Offset after a fault of a joint's sensor that is accepted at rest: a millimetre at the arm's
reach."""
STUCK_RAD = 0.01
"""Distance that a joint may have moved before its stuck sensor is noticed."""
STUCK_STEPS = 3.0
"""Motion, in multiples of twice a good sample's largest error, after which an encoder that shows
none is stuck."""
UNSEEN_S = 0.05
"""Time for which a joint may have accelerated while its stuck sensor was not yet noticed."""
BRAKE_TAIL_S2 = 1e-3
"""Braking distance of a joint beyond v^2 / 2 a, per rad/s2 of its braking."""
STRUCK_SPEED = 5.0
"""Multiple of the fastest velocity that a blow may give a joint within a cycle."""
SILENT_CYCLES = 2
"""Cycles without a new sample after which the sensors are silent; with none but old ones, after
which they are late."""
NO_SAMPLES = "sensors give no new samples"
DOUBTFUL = 0
GOOD = 1
TAKEN = 2
"""Verdicts on a sample; a good one is taken at once where no joint was in doubt."""


class Tolerance(NamedTuple):
    """What a good sample of an arm's sensors may be off by."""

    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s
    jitter_s: float  # by which it may be taken too early or too late, with all joints at full speed


def tolerance(cell: Cell) -> Tolerance:
    """Return what a `SensorMonitor` takes for good: two samples may be off either way."""
    off = 0.5 * FIT_RAD + cell.encoders.off
    jitter_s = float(np.min(off / cell.bounds.velocity))
    return Tolerance(off, cell.encoders.speed_off, jitter_s)


class SensorMonitor:
    """Checks every sample against the one before: positions must agree with the integrated
    velocities.

    A joint is good again when its samples agree with the estimate, and with each other, for
    `good_cycles` in a row: an offset greater than `doubt` is never accepted.
    """

    def __init__(self, cell: Cell, params: ArmParams, tick_s: float, every: int) -> None:
        """Check the joints of a cell in cycles of `every` ticks; they start at home."""
        self._good_cycles = params.good_cycles
        self._retry_cycles = max(round(params.retry / (every * tick_s)), params.good_cycles)
        encoders = cell.encoders
        bounds = cell.bounds
        home = cell.home
        self._low = bounds.position[:, 0] - BEYOND_RAD
        self._high = bounds.position[:, 1] + BEYOND_RAD
        self._tick_s = tick_s
        self._every = every
        joints = len(home)
        self._table = np.zeros((19, joints))  # in the rows of `check`
        self._q, self._qd, *self._raw = self._table[:4]  # the sample, and the one before it
        # (joints,), rad: as sensed; estimated for joints whose sensor is suspect. (joints,), rad/s,
        # likewise; unknown ones are estimated as braked. (joints,), rad: largest error of
        # `position`.
        self.position, self.velocity, self.doubt = self.estimate = self._table[4:7]
        self.state = self._table[4:6]  # (2, joints): `position` and `velocity`
        self._room, self._speed_room, self._unshown = self._table[7:10]
        self._still, self._still_way, self._claimed = self._table[10:13]
        self._way, self._allowed, self._braking, self._fastest = self._table[13:17]
        self._fits, self._unchanged = self._table[17:]
        self._braking[:] = cell.limits.acceleration
        self._fastest[:] = BEYOND_SPEED * bounds.velocity
        self._room[:] = FIT_RAD + 2.0 * encoders.off
        self._speed_room[:] = encoders.speed_off
        self._unshown[:] = np.maximum(STILL_RAD, STUCK_STEPS * 2.0 * encoders.off)
        self.position[:] = self._raw[0][:] = home
        self.fresh = True  # there is a sample of this cycle
        self.faulty = False  # a sensor is, or was until fewer than `good_cycles` ago, at fault
        self.drivable = True  # velocities are known, so the arm could still be driven
        self.blamed = (
            -1,
            0.0,
            0.0,
        )  # joint, its reading and error, rad; no sample: -1, age in ticks, 0
        self.findings: list[Finding] = []  # new ones, one per episode; the reader clears it
        self._unproven = np.zeros(joints, dtype=bool)  # stuck, and without a change since
        self._suspect = np.zeros(joints, dtype=bool)
        self._everyone = np.ones(joints, dtype=bool)
        self._sent = self._everyone  # its set point moves, or may have moved
        self._check = partial(check.load(), self._table, not encoders.exact)
        self._tick: int | None = None
        self._sampled = -sys.maxsize  # tick of the newest sample
        self._latency = encoders.latency_ticks
        self.missing = NO_SAMPLES  # what was wrong with all of them last
        self._late = 0  # cycles in a row with a new sample that was too old
        self._streak = 0  # good samples in a row
        self._rung: set[Alarm] = set()  # alarms raised in this episode

    def recall(self, state: Message) -> None:
        """Continue from the estimate in an `ArmState`."""
        self.position[:] = state.position
        self.velocity[:] = state.velocity
        self.doubt[:] = state.doubt
        self._tick = state.tick

    def adopt(self, sensed: Sensed, tick: int) -> bool:
        """Take the arm to be where this sample of `tick` has it; return whether it is one that can
        be taken.

        For an arm that is not driven yet: where it has been, and was moved to, nobody knows.
        """
        q, qd, _, _, sampled = sensed
        if sampled != tick or not (np.isfinite(q).all() and np.isfinite(qd).all()):
            return False
        for row, before in enumerate((q - self._every * self._tick_s * qd, qd)):
            self._table[2 + row] = self._table[4 + row] = before
        self.doubt[:] = 0.0
        self._tick = tick - self._every
        self._trust()
        return True

    def look(self, sensed: Sensed, tick: int, wanted: Array | None, struck: bool = False) -> None:
        """Check a sample at `tick`, and add faults to `findings`, once per episode.

        `wanted` is the motion that the arm was driven to follow, rad, rad/s, ... by row; None: it
        was not driven. `struck`: something has touched the arm since the last cycle.
        """
        q, qd, _, _, sampled = sensed
        passed = self._every if self._tick is None else tick - self._tick
        self._tick = tick
        passed_s = passed * self._tick_s
        self.fresh = sampled == tick
        self._late = self._late + 1 if sampled > self._sampled and not self.fresh else 0
        self._sampled = sampled
        if not self.fresh:
            self._estimate_blind(passed_s, tick - sampled)
            return
        # Driven for a while, then braked: in between it was faster than at both ends.
        braked_s = 4.0 * self._every * self._tick_s if passed > self._every else 0.0
        blow = STRUCK_SPEED if struck else 0.0
        driven = wanted is not None
        motion = self.state if wanted is None else wanted
        verdict = self._check(q, qd, motion, passed_s, braked_s, blow, driven, self.faulty)
        if verdict == TAKEN:
            return
        if verdict == GOOD:
            self._take(self._allowed)
            return
        self._sent = self._everyone if wanted is None else wanted[1] != 0.0
        fits = self._fits != 0.0
        if self.faulty:
            fits |= np.abs(self._q - self.position - self._way) <= self._allowed + self.doubt
        fastest = blow * self._fastest if struck else self._fastest
        self._doubtful(fits & (np.abs(self._qd) <= fastest), passed_s)

    def _take(self, room: Array) -> None:
        """Trust the sample; report a joint that this moves by more than `room`, rad."""
        q = self._q
        way = self._way
        self._unchanged[:] = q == self._raw[0]
        if self.doubt.any():
            off = q - self.position - way
            for joint in np.flatnonzero(np.abs(off) > room):
                self.findings.append(Finding(Alarm.RE_REFERENCED, int(joint), float(off[joint])))
            # A sensor that does not change proves nothing: it may be stuck.
            self.doubt[self._unchanged == 0.0] = 0.0
        self._table[4:6] = self._table[2:4] = self._table[:2]

    def _doubtful(self, fits: Mask, passed_s: float) -> None:
        """Report the faults of a sample, take its good joints, and estimate the others."""
        q = self._q
        qd = self._qd
        last_q, last_qd = self._raw
        way = self._way
        room = self._allowed
        finite = np.isfinite(q) & np.isfinite(qd)
        inside = (q >= self._low) & (q <= self._high)
        unchanged = (q == last_q) & (qd == last_qd)
        frozen = self._claimed > self._room
        still = np.asarray(
            (self._still >= STILL_CYCLES) & (np.abs(self._still_way) >= self._unshown)
        )
        begins = not self.faulty
        room += passed_s * np.abs(qd - last_qd)
        steady = np.abs(q - last_q - (0.5 * passed_s) * (qd + last_qd)) <= room
        off = q - self.position - way
        self._name(Alarm.SENSOR_RANGE, ~finite | ~inside, q)
        self._name(Alarm.SENSOR_STUCK, frozen | still, self._still)
        self._name(Alarm.SENSOR_MODEL, finite & ~fits & ~frozen, off)
        good = fits & steady & inside & ~still & ~frozen
        self.drivable = bool((np.isfinite(qd) & ~frozen & ~still).all())
        self.doubt[still] += STUCK_RAD
        self._unproven |= still
        self._unproven &= unchanged
        if begins:
            # A sensor that showed no change may have been stuck while its joint crept: it may be
            # off by that distance.
            np.maximum(
                self.doubt,
                np.where(self._unchanged != 0.0, STUCK_RAD, PLAUSIBLE_RAD),
                out=self.doubt,
            )
            # One that shows no change now, although its joint was driven, may have been stuck for
            # longer.
            unseen = (UNSEEN_S * UNSEEN_S + BRAKE_TAIL_S2) * self._braking + self._unshown
            np.maximum(self.doubt, unseen, out=self.doubt, where=unchanged & self._sent)
        self._still[still] = 0
        if not good.all():
            amount = np.where(np.isfinite(off), np.abs(off), np.inf)
            joint = int(np.where(good, -1.0, amount).argmax())
            self.blamed = joint, float(q[joint]), float(off[joint])
        self._suspect |= ~good
        if self._settled(bool(good.all())):
            self._take(self._room)
            return
        self._table[2:4] = self._table[:2]
        self._estimate(q, qd, way, np.isfinite(qd) & ~frozen, passed_s)

    def _estimate(self, q: Array, qd: Array, way: Array, known: Mask, passed_s: float) -> None:
        """Estimate suspect joints from their velocity, or as braked where that is unknown; take the
        others as sensed.

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
        is_late = self._late >= SILENT_CYCLES
        if is_late:
            self._ring(Finding(Alarm.SENSOR_LATE, -1, age))
            self.missing = (
                f"the newest sample is {age} ticks old; permitted by robot.latency_ticks:"
                f" {self._latency}"
            )
        elif not self._late and age >= SILENT_CYCLES * self._every:
            self._ring(Finding(Alarm.SENSOR_SILENT, -1, age))
            self.missing = NO_SAMPLES
        if is_late or age >= SILENT_CYCLES * self._every:
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

    def _name(self, alarm: Alarm, wrong: Mask, values: Array | Ints) -> None:
        if wrong.any():
            joint = int(wrong.argmax())
            self._ring(Finding(alarm, joint, float(values[joint])))

    def _ring(self, finding: Finding) -> None:
        self.faulty = True
        self._streak = 0
        if finding.alarm not in self._rung:
            self._rung.add(finding.alarm)
            self.findings.append(finding)

    def _settled(self, good: bool) -> bool:
        """Count good samples in a row; return whether they are enough to end the episode."""
        self._streak = self._streak + 1 if good else 0
        needed = self._retry_cycles if self._unproven.any() else self._good_cycles
        if self._streak < needed:
            return False
        self._trust()
        return True

    def _trust(self) -> None:
        """End an episode."""
        self.faulty = False
        self._streak = 0
        self._unproven[:] = False
        self._suspect[:] = False
        self._rung.clear()


@compiled_for("f8[:,::1], b1, f8[::1], f8[::1], f8[:,::1], f8, f8, f8, b1, b1")
def check(  # noqa: PLR0913  # flat, as `advance` in levels/arm/substeps.py
    table: Array,  # (19, joints): rows as below
    coarse: bool,
    sensed: Array,  # (joints,), rad
    sensed_velocity: Array,  # (joints,), rad/s
    wanted: Array,  # (2, joints) or more, rad, rad/s: the motion that the arm was driven to follow
    passed_s: float,
    braked_s: float,  # time for which it may have braked, in unusual cycles
    blow: float,  # multiple of the fastest velocity that something may have given it
    driven: bool,
    faulty: bool,
) -> int:
    """Check a sample against the estimate, and take it if nothing is in doubt; return the
    verdict."""
    # This sample and the one before it, rad and rad/s; the estimate: rad, rad/s, rad.
    q, qd, last_q, last_qd, position, velocity, doubt = table[:7]
    # For errors, rad and rad/s; motion that must show, rad. Cycles without a change while the set
    # point moves, and its motion in that time, rad; integrated velocity while the sample does not
    # change, rad.
    room, speed_room, unshown, still, still_way, claimed = table[7:13]
    # Set here: motion since the last sample, and room for its errors, rad. Braking, rad/s2, and
    # greatest velocity, rad/s. Set to 0 or 1: agrees with velocities; if taken, is as before.
    way, allowed, braking, fastest, fits, unchanged = table[13:]
    good = not faulty
    in_doubt = False
    at_rest = False
    for j in range(len(q)):
        q[j] = sensed[j]
        qd[j] = sensed_velocity[j]
        at_rest = at_rest or (driven and qd[j] == velocity[j])
    for j in range(len(q)):
        change = qd[j] - velocity[j]
        way[j] = (0.5 * passed_s) * (qd[j] + velocity[j])
        further = passed_s * (braked_s * braking[j] + blow * fastest[j])
        allowed[j] = room[j] + passed_s * (abs(change) + speed_room[j]) + further
        fitting = abs(q[j] - position[j] - way[j]) <= allowed[j]  # never true for NaN
        fits[j] = 1.0 if fitting else 0.0
        same = q[j] == last_q[j]
        unmoved = at_rest and change == 0.0 and same and wanted[1, j] != 0.0
        still[j] = still[j] + 1.0 if unmoved else 0.0
        still_way[j] = still_way[j] + passed_s * wanted[1, j] if unmoved else 0.0
        good = (
            good and fitting and not (still[j] >= STILL_CYCLES and abs(still_way[j]) >= unshown[j])
        )
        least = max(abs(qd[j]) - speed_room[j], 0.0)
        claimed[j] = claimed[j] + passed_s * least if same and qd[j] == last_qd[j] else 0.0
        # An exact sensor that is stuck shows it in the next sample.
        good = good and not (coarse and claimed[j] > room[j])
        in_doubt = in_doubt or doubt[j] != 0.0
    if not good or in_doubt:
        return GOOD if good else DOUBTFUL
    for j in range(len(q)):
        unchanged[j] = 1.0 if q[j] == last_q[j] else 0.0
        last_q[j] = position[j] = q[j]
        last_qd[j] = velocity[j] = qd[j]
    return TAKEN
