"""Checks the joints' sensors, and estimates where the arm is while they are wrong."""

from __future__ import annotations

import sys
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array, Ints, Mask
from rack.levels.arm import Sensed
from rack.levels.compiled import compiled_for
from rack.levels.level import Finding
from rack.levels.messages import ArmState
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
MONITORED = np.dtype(
    [
        ("position", "f8"),  # rad: the sample
        ("velocity", "f8"),  # rad/s
        ("last_position", "f8"),  # rad: the sample before it
        ("last_velocity", "f8"),  # rad/s
        ("tolerance", "f8"),  # rad: largest error of a good sample
        ("velocity_tolerance", "f8"),  # rad/s
        ("unshown", "f8"),  # rad: largest motion that a good sensor may not show
        ("braking", "f8"),  # rad/s2: of the brakes
        ("fastest", "f8"),  # rad/s: no sample is faster
        ("still_cycles", "f8"),  # without a change while the set point moves
        ("still_way", "f8"),  # rad: motion of the set point in that time
        ("claimed", "f8"),  # rad: integrated velocity while the sample does not change
        ("way", "f8"),  # rad: motion since the last sample, by velocities
        ("allowed", "f8"),  # rad: largest error of a good sample after that motion
        ("fits", "?"),  # the sample agrees with that motion
        ("unchanged", "?"),  # it was taken, and is as the one before
    ],
    align=True,
)
"""What is known of a joint's sensor, besides the estimate."""
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
        # (joints,), rad: as sensed; estimated for joints whose sensor is suspect. (joints,), rad/s,
        # likewise; unknown ones are estimated as braked. (joints,), rad: largest error of
        # `position`.
        self.position, self.velocity, self.doubt = self.estimate = np.zeros((3, joints))
        self.state = self.estimate[:2]  # (2, joints): `position` and `velocity`
        self._joints = np.zeros(joints, MONITORED)
        self._joints["braking"] = cell.limits.acceleration
        self._joints["fastest"] = BEYOND_SPEED * bounds.velocity
        self._joints["tolerance"] = FIT_RAD + 2.0 * encoders.off
        self._joints["velocity_tolerance"] = encoders.speed_off
        self._joints["unshown"] = np.maximum(STILL_RAD, STUCK_STEPS * 2.0 * encoders.off)
        self.position[:] = self._joints["last_position"] = home
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
        self._check = partial(check.load(), self._joints, self.estimate, not encoders.exact)
        self._tick: int | None = None
        self._sampled = -sys.maxsize  # tick of the newest sample
        self._latency = encoders.latency_ticks
        self.missing = NO_SAMPLES  # what was wrong with all of them last
        self._late = 0  # cycles in a row with a new sample that was too old
        self._streak = 0  # good samples in a row
        self._rung: set[Alarm] = set()  # alarms raised in this episode

    def recall(self, state: ArmState) -> None:
        """Continue from the estimate in an `ARM_STATE`."""
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
        joints = self._joints
        joints["last_position"] = self.position[:] = q - self._every * self._tick_s * qd
        joints["last_velocity"] = self.velocity[:] = qd
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
        joints = self._joints
        if verdict == GOOD:
            self._take(joints["allowed"])
            return
        self._sent = self._everyone if wanted is None else wanted[1] != 0.0
        fits = joints["fits"]
        if self.faulty:
            off = joints["position"] - self.position - joints["way"]
            fits = fits | (np.abs(off) <= joints["allowed"] + self.doubt)
        fastest = blow * joints["fastest"] if struck else joints["fastest"]
        self._doubtful(fits & (np.abs(joints["velocity"]) <= fastest), passed_s)

    def _take(self, room: Array) -> None:
        """Trust the sample; report a joint that this moves by more than `room`, rad."""
        joints = self._joints
        q = joints["position"]
        joints["unchanged"] = q == joints["last_position"]
        if self.doubt.any():
            off = q - self.position - joints["way"]
            for joint in np.flatnonzero(np.abs(off) > room):
                self.findings.append(Finding(Alarm.RE_REFERENCED, int(joint), float(off[joint])))
            # A sensor that does not change proves nothing: it may be stuck.
            self.doubt[~joints["unchanged"]] = 0.0
        self.position[:] = q
        self.velocity[:] = joints["velocity"]
        self._keep_sample()

    def _keep_sample(self) -> None:
        """Keep the sample as the last one."""
        for field in ("position", "velocity"):
            self._joints[f"last_{field}"] = self._joints[field]

    def _doubtful(self, fits: Mask, passed_s: float) -> None:
        """Report the faults of a sample, take its good joints, and estimate the others."""
        joints = self._joints
        q = joints["position"]
        qd = joints["velocity"]
        last_q = joints["last_position"]
        last_qd = joints["last_velocity"]
        way = joints["way"]
        room = joints["allowed"]
        cycles = joints["still_cycles"]
        finite = np.isfinite(q) & np.isfinite(qd)
        inside = (q >= self._low) & (q <= self._high)
        unchanged = (q == last_q) & (qd == last_qd)
        frozen = joints["claimed"] > joints["tolerance"]
        still = (cycles >= STILL_CYCLES) & (np.abs(joints["still_way"]) >= joints["unshown"])
        begins = not self.faulty
        room += passed_s * np.abs(qd - last_qd)
        steady = np.abs(q - last_q - (0.5 * passed_s) * (qd + last_qd)) <= room
        off = q - self.position - way
        self._name(Alarm.SENSOR_RANGE, ~finite | ~inside, q)
        self._name(Alarm.SENSOR_STUCK, frozen | still, cycles)
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
                np.where(joints["unchanged"], STUCK_RAD, PLAUSIBLE_RAD),
                out=self.doubt,
            )
            # One that shows no change now, although its joint was driven, may have been stuck for
            # longer.
            unseen = (UNSEEN_S * UNSEEN_S + BRAKE_TAIL_S2) * joints["braking"] + joints["unshown"]
            np.maximum(self.doubt, unseen, out=self.doubt, where=unchanged & self._sent)
        cycles[still] = 0
        if not good.all():
            amount = np.where(np.isfinite(off), np.abs(off), np.inf)
            joint = int(np.where(good, -1.0, amount).argmax())
            self.blamed = joint, float(q[joint]), float(off[joint])
        self._suspect |= ~good
        if self._settled(bool(good.all())):
            self._take(joints["tolerance"])
            return
        self._keep_sample()
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
        braking = self._joints["braking"]
        time_s = np.minimum(passed_s, speed / braking)
        way = (speed - 0.5 * braking * time_s) * time_s * joints
        # Until the brakes engage the last torque still acts.
        acting = 2.0 * braking * passed_s * self._every * self._tick_s
        self.position += np.copysign(way, self.velocity)
        np.maximum(self.doubt, BRAKE_TAIL_S2 * braking, out=self.doubt, where=joints)
        self.doubt += way + acting * joints * (speed > 0.0)
        slower = np.copysign(np.maximum(speed - braking * time_s, 0.0), self.velocity)
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


@compiled_for("f8[:,::1], b1, f8[::1], f8[::1], f8[:,::1], f8, f8, f8, b1, b1", MONITORED)
def check(  # noqa: PLR0913  # flat, as `advance` in levels/arm/substeps.py
    joints: NDArray[np.void],  # (joints,): MONITORED
    estimate: Array,  # (3, joints), rad, rad/s, rad: position, velocity, and largest error of both
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
    verdict.
    """
    position, velocity, doubt = estimate
    good = not faulty
    in_doubt = False
    at_rest = False
    for j in range(len(joints)):
        at_rest = at_rest or (driven and sensed_velocity[j] == velocity[j])
    for j in range(len(joints)):
        joint = joints[j]
        q = sensed[j]
        qd = sensed_velocity[j]
        joint["position"] = q
        joint["velocity"] = qd
        change = qd - velocity[j]
        way = (0.5 * passed_s) * (qd + velocity[j])
        further = passed_s * (braked_s * joint["braking"] + blow * joint["fastest"])
        room = passed_s * (abs(change) + joint["velocity_tolerance"])
        joint["way"] = way
        joint["allowed"] = joint["tolerance"] + room + further
        fits = abs(q - position[j] - way) <= joint["allowed"]  # never true for NaN
        joint["fits"] = fits
        same = q == joint["last_position"]
        if at_rest and change == 0.0 and same and wanted[1, j] != 0.0:
            joint["still_cycles"] += 1.0
            joint["still_way"] += passed_s * wanted[1, j]
        else:
            joint["still_cycles"] = 0.0
            joint["still_way"] = 0.0
        is_long = joint["still_cycles"] >= STILL_CYCLES
        still = is_long and abs(joint["still_way"]) >= joint["unshown"]
        if same and qd == joint["last_velocity"]:
            joint["claimed"] += passed_s * max(abs(qd) - joint["velocity_tolerance"], 0.0)
        else:
            joint["claimed"] = 0.0
        # An exact sensor that is stuck shows it in the next sample.
        frozen = coarse and joint["claimed"] > joint["tolerance"]
        good = good and fits and not (still or frozen)
        in_doubt = in_doubt or doubt[j] != 0.0
    if not good or in_doubt:
        return GOOD if good else DOUBTFUL
    for j in range(len(joints)):
        joint = joints[j]
        joint["unchanged"] = joint["position"] == joint["last_position"]
        joint["last_position"] = position[j] = joint["position"]
        joint["last_velocity"] = velocity[j] = joint["velocity"]
    return TAKEN
