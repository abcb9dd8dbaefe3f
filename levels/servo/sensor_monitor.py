"""Checks the sensors of the joints, and estimates the state of the arm while they are wrong."""

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
"""Permitted difference between a position and the integrated velocities. Runs without faults
reach a twentieth of it."""
BEYOND_RAD = 0.05
"""Distance beyond its position range that no joint can reach."""
BEYOND_SPEED = 1.2
"""Multiple of its velocity limit that no joint can reach."""
STILL_CYCLES = 10
"""Cycles without any change, while the set point moves, after which a sensor counts as stuck."""
STILL_RAD = 5e-5
"""Minimum motion of the set point in that time. It is small, because even a slow joint soon runs
away with a stuck sensor."""
PLAUSIBLE_RAD = 1e-3
"""Offset that is accepted after a sensor fault: about a millimetre at the tool."""
STUCK_RAD = 0.01
"""Distance that a joint may move before its stuck sensor is detected."""
STUCK_STEPS = 3.0
"""Motion, in multiples of twice the largest error of a good sample, after which an encoder that
does not change counts as stuck."""
UNSEEN_S = 0.05
"""Time for which a joint may have accelerated before its stuck sensor was detected."""
BRAKE_TAIL_S2 = 1e-3
"""Braking distance of a joint in addition to v^2 / 2 a, per rad/s2 of deceleration."""
STRUCK_SPEED = 5.0
"""Multiple of its fastest velocity that a blow may give a joint within a cycle."""
SILENT_CYCLES = 2
"""Cycles without a new sample after which the sensors count as silent. After as many cycles in
which new samples are too old, they count as late."""
NO_SAMPLES = "sensors give no new samples"
MONITORED = np.dtype(
    [
        ("position", "f8"),  # rad: of the sample
        ("velocity", "f8"),  # rad/s
        ("last_position", "f8"),  # rad: of the sample before
        ("last_velocity", "f8"),  # rad/s
        ("tolerance", "f8"),  # rad: largest error of a good sample
        ("velocity_tolerance", "f8"),  # rad/s
        ("unshown", "f8"),  # rad: largest motion that a good sensor may not show
        ("braking", "f8"),  # rad/s2: deceleration by the brakes
        ("fastest", "f8"),  # rad/s: no sample is faster
        ("still_cycles", "f8"),  # cycles without a change while the set point moves
        ("still_way", "f8"),  # rad: motion of the set point in these cycles
        ("claimed", "f8"),  # rad: integrated velocity while the sample does not change
        ("way", "f8"),  # rad: motion since the last sample, by velocities
        ("allowed", "f8"),  # rad: largest error of a good sample after that motion
        ("fits", "?"),  # the sample agrees with that motion within `allowed`
        ("unchanged", "?"),  # the accepted sample equals the one before
    ],
    align=True,
)
"""State of the monitor for one joint, besides the estimate."""
DOUBTFUL = 0
GOOD = 1
TAKEN = 2
"""Verdicts on a sample. TAKEN is a good sample that was accepted at once, because no joint was in
doubt."""


class Tolerance(NamedTuple):
    """Error bounds of a good sensor sample."""

    position: Array  # (joints,), rad
    velocity: Array  # (joints,), rad/s
    jitter_s: float  # permitted error of the sampling time at full speed


def compute_tolerance(cell: Cell) -> Tolerance:
    """Return the errors that a `SensorMonitor` tolerates in one sample.

    The monitor compares the positions of two samples, so each may use half of the tolerance.
    """
    position_error = 0.5 * FIT_RAD + cell.encoders.position_error
    jitter_s = float(np.min(position_error / cell.bounds.velocity))
    return Tolerance(position_error, cell.encoders.velocity_error, jitter_s)


class SensorMonitor:
    """Checks every sample against the previous one: positions must match integrated velocities.

    An episode of faults begins with the first fault. It ends when the samples have agreed with the
    estimate, and with each other, for `good_cycles` in a row; all sensors are then trusted again.
    An offset greater than `doubt` is never accepted.

    Attributes:
        position: (joints,), rad. Sensed, or estimated for joints whose sensor is suspect.
        velocity: (joints,), rad/s, likewise. Unknown velocities are estimated as if braked.
        doubt: (joints,), rad. Largest error of `position`.
        estimate: `position`, `velocity` and `doubt` as rows, (3, joints).
        state: `position` and `velocity` as rows, (2, joints).
        fresh: True if there is a sample of this cycle.
        faulty: An episode of faults has not ended.
        drivable: True if all velocities are known, so that the arm could still be driven.
        blamed: Joint at fault, its reading, rad, and its error, rad. If there are no samples: -1,
            the age of the newest sample in ticks, and 0.
        findings: New findings, one per alarm and episode. The reader clears the list.
        missing: Reason why samples were missing the last time.
    """

    def __init__(self, cell: Cell, params: ArmParams, tick_s: float, every: int) -> None:
        """Monitor the sensors of an arm, which starts at home.

        Args:
            cell: Model of the arm and its encoders.
            params: Parameters of the board.
            tick_s: Duration of a tick.
            every: Ticks from cycle to cycle.
        """
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
        self.position, self.velocity, self.doubt = self.estimate = np.zeros((3, joints))
        self.state = self.estimate[:2]
        self._joints = np.zeros(joints, MONITORED)
        self._joints["braking"] = cell.limits.acceleration
        self._joints["fastest"] = BEYOND_SPEED * bounds.velocity
        self._joints["tolerance"] = FIT_RAD + 2.0 * encoders.position_error
        self._joints["velocity_tolerance"] = encoders.velocity_error
        self._joints["unshown"] = np.maximum(STILL_RAD, STUCK_STEPS * 2.0 * encoders.position_error)
        self.position[:] = self._joints["last_position"] = home
        self.fresh = True
        self.faulty = False
        self.drivable = True
        self.blamed = -1, 0.0, 0.0
        self.findings: list[Finding] = []
        self._unproven = np.zeros(joints, dtype=bool)  # was stuck and has not changed since
        self._suspect = np.zeros(joints, dtype=bool)
        self._everyone = np.ones(joints, dtype=bool)
        self._sent = self._everyone  # joints whose set points move, or may have moved
        self._check = partial(
            check.load_machine_code(), self._joints, self.estimate, not encoders.is_exact
        )
        self._tick: int | None = None
        self._sampled = -sys.maxsize  # tick of the newest sample
        self._latency = encoders.latency_ticks
        self.missing = NO_SAMPLES
        self._late = 0  # consecutive cycles with a new sample that was too old
        self._streak = 0  # consecutive good samples
        self._rung: set[Alarm] = set()  # alarms raised in this episode

    def restore_estimate(self, state: ArmState) -> None:
        """Continue from the estimate in an `ArmState` after a restart."""
        self.position[:] = state.position
        self.velocity[:] = state.velocity
        self.doubt[:] = state.doubt
        self._tick = state.tick

    def adopt_pose(self, sensed: Sensed, tick: int) -> bool:
        """Accept the sensed pose without comparing it with earlier samples.

        Use this for an arm that is not driven yet, because it may have been moved by hand.

        Returns:
            False if the sample is not of `tick` or not finite.
        """
        q, qd, _, _, sampled = sensed
        if sampled != tick or not (np.isfinite(q).all() and np.isfinite(qd).all()):
            return False
        joints = self._joints
        joints["last_position"] = self.position[:] = q - self._every * self._tick_s * qd
        joints["last_velocity"] = self.velocity[:] = qd
        self.doubt[:] = 0.0
        self._tick = tick - self._every
        self._end_episode()
        return True

    def check_sample(self, sensed: Sensed, tick: int, wanted: Array | None, struck: bool) -> None:
        """Check the sample of a cycle, and add faults to `findings`, once per episode.

        Args:
            sensed: Newest sample.
            tick: Tick of the cycle.
            wanted: Motion that the arm was driven to follow: its first rows are rad and rad/s. None
                if the arm was not driven.
            struck: True if something has touched the arm since the last cycle.
        """
        q, qd, _, _, sampled = sensed
        passed = self._every if self._tick is None else tick - self._tick
        self._tick = tick
        passed_s = passed * self._tick_s
        self.fresh = sampled == tick
        self._late = self._late + 1 if sampled > self._sampled and not self.fresh else 0
        self._sampled = sampled
        if not self.fresh:
            self._estimate_without_sample(passed_s, tick - sampled)
            return
        # During missed cycles the arm was driven and then braked, so it may have been faster than
        # in either sample.
        braked_s = 4.0 * self._every * self._tick_s if passed > self._every else 0.0
        blow = STRUCK_SPEED if struck else 0.0
        driven = wanted is not None
        motion = self.state if wanted is None else wanted
        verdict = self._check(q, qd, motion, passed_s, braked_s, blow, driven, self.faulty)
        if verdict == TAKEN:
            return
        joints = self._joints
        if verdict == GOOD:
            self._accept_sample(joints["allowed"])
            return
        self._sent = self._everyone if wanted is None else wanted[1] != 0.0
        fitting = joints["fits"]
        if self.faulty:
            offset = joints["position"] - self.position - joints["way"]
            fitting = fitting | (np.abs(offset) <= joints["allowed"] + self.doubt)
        fastest = blow * joints["fastest"] if struck else joints["fastest"]
        self._process_doubtful_sample(fitting & (np.abs(joints["velocity"]) <= fastest), passed_s)

    def _accept_sample(self, tolerance: Array) -> None:
        """Accept the sample as the new estimate.

        Args:
            tolerance: Change of the estimate, (joints,), rad, beyond which a joint is reported.
        """
        joints = self._joints
        q = joints["position"]
        joints["unchanged"] = q == joints["last_position"]
        if self.doubt.any():
            offset = q - self.position - joints["way"]
            for joint in np.flatnonzero(np.abs(offset) > tolerance):
                self.findings.append(Finding(Alarm.RE_REFERENCED, int(joint), float(offset[joint])))
            # A sensor whose value does not change may be stuck, so its joint remains in doubt.
            self.doubt[~joints["unchanged"]] = 0.0
        self.position[:] = q
        self.velocity[:] = joints["velocity"]
        self._keep_sample()

    def _keep_sample(self) -> None:
        """Store the sample for comparison with the next one."""
        for field in ("position", "velocity"):
            self._joints[f"last_{field}"] = self._joints[field]

    def _process_doubtful_sample(self, fits: Mask, passed_s: float) -> None:
        """Report the faults of a sample, accept its good joints, and estimate the others.

        Args:
            fits: Joints whose positions and velocities agree with the estimate.
            passed_s: Time since the last sample.
        """
        joints = self._joints
        q = joints["position"]
        qd = joints["velocity"]
        last_q = joints["last_position"]
        last_qd = joints["last_velocity"]
        travel = joints["way"]
        allowed = joints["allowed"]
        cycles = joints["still_cycles"]
        finite = np.isfinite(q) & np.isfinite(qd)
        inside = (q >= self._low) & (q <= self._high)
        unchanged = (q == last_q) & (qd == last_qd)
        frozen = joints["claimed"] > joints["tolerance"]
        still = (cycles >= STILL_CYCLES) & (np.abs(joints["still_way"]) >= joints["unshown"])
        begins = not self.faulty
        allowed += passed_s * np.abs(qd - last_qd)
        steady = np.abs(q - last_q - (0.5 * passed_s) * (qd + last_qd)) <= allowed
        offset = q - self.position - travel
        self._report_joint(Alarm.SENSOR_RANGE, ~finite | ~inside, q)
        self._report_joint(Alarm.SENSOR_STUCK, frozen | still, cycles)
        self._report_joint(Alarm.SENSOR_MODEL, finite & ~fits & ~frozen, offset)
        good = fits & steady & inside & ~still & ~frozen
        self.drivable = bool((np.isfinite(qd) & ~frozen & ~still).all())
        self.doubt[still] += STUCK_RAD
        self._unproven |= still
        self._unproven &= unchanged
        if begins:
            # A sensor whose value did not change may have been stuck while its joint crept. Its
            # error may be as large as the motion at which a stuck sensor is detected.
            np.maximum(
                self.doubt,
                np.where(joints["unchanged"], STUCK_RAD, PLAUSIBLE_RAD),
                out=self.doubt,
            )
            # A sensor may also have been stuck while its joint was accelerated.
            unseen = (UNSEEN_S * UNSEEN_S + BRAKE_TAIL_S2) * joints["braking"] + joints["unshown"]
            np.maximum(self.doubt, unseen, out=self.doubt, where=unchanged & self._sent)
        cycles[still] = 0
        if not good.all():
            amount = np.where(np.isfinite(offset), np.abs(offset), np.inf)
            joint = int(np.where(good, -1.0, amount).argmax())
            self.blamed = joint, float(q[joint]), float(offset[joint])
        self._suspect |= ~good
        if self._count_good_sample(bool(good.all())):
            self._accept_sample(joints["tolerance"])
            return
        self._keep_sample()
        self._estimate_suspects(q, qd, travel, np.isfinite(qd) & ~frozen, passed_s)

    def _estimate_suspects(
        self, q: Array, qd: Array, travel: Array, known: Mask, passed_s: float
    ) -> None:
        """Estimate the suspect joints, and accept the others as sensed.

        A suspect joint is estimated from its sensed velocity or, if that is unknown, as if braked.
        Its sensed position is not used even if it happens to fit, because with noise the estimate
        would drift.

        Args:
            q: Sensed positions, rad.
            qd: Sensed velocities, rad/s.
            travel: Motion since the last sample according to the velocities, rad.
            known: Joints whose velocity is known.
            passed_s: Time since the last sample.
        """
        coasting = self._suspect & known
        self.doubt[coasting] += 0.5 * passed_s * np.abs(qd - self.velocity)[coasting]
        self._estimate_braking(self._suspect & ~known, passed_s)
        np.copyto(self.position, q, where=~self._suspect)
        np.add(self.position, travel, out=self.position, where=coasting)
        np.copyto(self.velocity, qd, where=known)

    def _estimate_without_sample(self, passed_s: float, age: int) -> None:
        """Estimate all joints in a cycle without a current sample.

        Args:
            passed_s: Time since the last cycle.
            age: Age of the newest sample in ticks.
        """
        is_late = self._late >= SILENT_CYCLES
        is_silent = age >= SILENT_CYCLES * self._every
        if is_late:
            self._report_fault(Finding(Alarm.SENSOR_LATE, -1, age))
            self.missing = (
                f"the newest sample is {age} ticks old; permitted by robot.latency_ticks:"
                f" {self._latency}"
            )
        elif is_silent and not self._late:
            self._report_fault(Finding(Alarm.SENSOR_SILENT, -1, age))
            self.missing = NO_SAMPLES
        if is_late or is_silent:
            self.drivable = False
            self._suspect[:] = True
            self.blamed = -1, float(age), 0.0
        self._streak = 0
        self._estimate_braking(self._everyone, passed_s)

    def _estimate_braking(self, joints: Mask, passed_s: float) -> None:
        """Estimate the motion of joints under the brakes.

        Args:
            joints: Joints to estimate.
            passed_s: Time since the last estimate.
        """
        if not joints.any():
            return
        speed = np.abs(self.velocity)
        braking = self._joints["braking"]
        time_s = np.minimum(passed_s, speed / braking)
        travel = (speed - 0.5 * braking * time_s) * time_s * joints
        # The last torque acts until the brakes engage.
        acting = 2.0 * braking * passed_s * self._every * self._tick_s
        self.position += np.copysign(travel, self.velocity)
        np.maximum(self.doubt, BRAKE_TAIL_S2 * braking, out=self.doubt, where=joints)
        self.doubt += travel + acting * joints * (speed > 0.0)
        slower = np.copysign(np.maximum(speed - braking * time_s, 0.0), self.velocity)
        np.copyto(self.velocity, slower, where=joints)

    def _report_joint(self, alarm: Alarm, wrong: Mask, values: Array | Ints) -> None:
        """Report the first wrong joint, if there is one.

        Args:
            alarm: Alarm to report.
            wrong: Joints that are wrong.
            values: Value to report for each joint.
        """
        if wrong.any():
            joint = int(wrong.argmax())
            self._report_fault(Finding(alarm, joint, float(values[joint])))

    def _report_fault(self, finding: Finding) -> None:
        """Report a fault once per alarm and episode, and restart the count of good samples."""
        self.faulty = True
        self._streak = 0
        if finding.alarm not in self._rung:
            self._rung.add(finding.alarm)
            self.findings.append(finding)

    def _count_good_sample(self, good: bool) -> bool:
        """Count consecutive good samples. Return True if they were enough to end the episode."""
        self._streak = self._streak + 1 if good else 0
        needed = self._retry_cycles if self._unproven.any() else self._good_cycles
        if self._streak < needed:
            return False
        self._end_episode()
        return True

    def _end_episode(self) -> None:
        """End an episode, and trust all sensors again."""
        self.faulty = False
        self._streak = 0
        self._unproven[:] = False
        self._suspect[:] = False
        self._rung.clear()


@compiled_for("f8[:,::1], b1, f8[::1], f8[::1], f8[:,::1], f8, f8, f8, b1, b1", MONITORED)
def check(  # noqa: PLR0913  # flat, as `advance` in levels/arm/substeps.py
    joints: NDArray[np.void],  # (joints,): MONITORED
    estimate: Array,  # (3, joints), rad, rad/s, rad
    coarse: bool,
    sensed: Array,  # (joints,), rad
    sensed_velocity: Array,  # (joints,), rad/s
    wanted: Array,  # (2, joints) or more, rad, rad/s
    passed_s: float,
    braked_s: float,
    blow: float,
    driven: bool,
    faulty: bool,
) -> int:
    """Check a sample against the estimate, and accept it if no joint is in doubt.

    Args:
        joints: State of the monitor.
        estimate: Positions, velocities and largest position errors.
        coarse: True if the encoders are not exact.
        sensed: Positions of the sample.
        sensed_velocity: Velocities of the sample.
        wanted: Motion that the arm was driven to follow.
        passed_s: Time since the last sample.
        braked_s: Time for which the arm may have braked. 0 unless cycles were missed.
        blow: Multiple of the fastest velocity that a blow may have added.
        driven: True if the arm was driven.
        faulty: An episode of faults has not ended.

    Returns:
        DOUBTFUL, GOOD or TAKEN.
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
        travel = (0.5 * passed_s) * (qd + velocity[j])
        further = passed_s * (braked_s * joint["braking"] + blow * joint["fastest"])
        velocity_room = passed_s * (abs(change) + joint["velocity_tolerance"])
        joint["way"] = travel
        joint["allowed"] = joint["tolerance"] + velocity_room + further
        fits = abs(q - position[j] - travel) <= joint["allowed"]  # never true for NaN
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
        # With exact encoders, the next sample of a stuck sensor does not fit anyway.
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
