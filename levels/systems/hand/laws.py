"""The laws of the fingertips, the joints and the tendons of a hand.

The law of the fingertips: joint targets from what is wanted of the fingers, each in one of three
modes.

JOINTS: the targets are those given. POINT: inverse kinematics, a few damped steps a cycle from the
targets before. FORCE: torque = J^T force + J^T k J (joints at the point - joints), a spring of
stiffness k about a point, the same in all directions (Salisbury, "Active stiffness control of a
manipulator in Cartesian coordinates", 1980). The stiffness by joints, J^T k J, goes to the joint
loop: closed at its rate the spring is stable at a stiffness at which, closed at the rate of this
loop, it is not. The joint loop also damps it, and a small part of its own stiffness keeps the
posture: the tip leaves one joint of a finger undetermined.

The law of the joints: torques that make every joint's error that of a damped oscillator, as
stiff as is wanted.

torque = M(q) (2 d w (qd_wanted - qd) + s w^2 e) + S e + torque of tip forces + weight(q) +
friction(qd_wanted)

e = q_wanted - q. `s`, 0 to 1 a joint, is the part of the stiffness that acts; S is that of tips
which are springs. The damping always acts, so a finger that only exerts a force is still slow. The
weight of a finger is small, but at a joint that is soft it would cost degrees. Viscous friction is
fed forward for the velocity wanted, not for the one sensed: what damps is not cancelled. The sample
is taken on to when the torque acts, a valve's lag included, at the velocity sensed.

The law of the tendons: tensions for a torque, early enough for slow valves, and corrected by
what is sensed.

A pair turns its joint with torque = a (Tf - Te), a being its moment arm. Of all tensions that give
a torque, those about a mean T0 are Tf = T0 + torque / 2a and Te = T0 - torque / 2a: the statics of
a symmetric pair. Tendons only pull: where one would go slack, the mean is raised; where the other
could then not pull enough, the torque is clipped.

A valve follows its command with a lag [assumed: of first order]. `lead` commands more than is
wanted while the tension, by a model of the valve, has not arrived: it is then there (1 + lead)
times as soon, and nothing sensed is fed back, so the delays on the way to and from the hand cannot
make it unstable. What the model lacks, gain and offset of a valve, is an error that lasts: `trim`
integrates the difference of the sensed tension from that of the model, far slower than the lag. The
model for this runs on the commands that the hand reports with each sample: both are of the same
time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field

from rack.levels.algebra import Array, Mask, gram, transposed_mat_vec
from rack.levels.compiled import compiled_for
from rack.levels.level import LevelContext
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED, Dynamics
from rack.levels.robot.hand import Hand
from rack.levels.servo.driver import numbers
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.messages import FingerMode, FingerTarget, GraspTarget, HandStatus
from rack.levels.tables import NotNegative, Positive, Table

HOMING = 0.02
"""Part of the way to the finger's posture that its undetermined joint goes in a step."""
STEPS = 2
"""Steps of inverse kinematics in a cycle."""


class FingertipGains(Table):
    """Gains of the fingertip loop."""

    posture: NotNegative = Field(0.2, le=1.0)
    """part of the joint loop's stiffness that keeps the posture of a finger in mode FORCE"""


class FingertipLaw:
    """Sets the joint targets of some fingers of a hand."""

    def __init__(
        self,
        kinematics: FingerKinematics,
        fingers: Sequence[int],
        gains: FingertipGains,
        period_s: float,
    ) -> None:
        """Drive `fingers`, by index, every `period_s`."""
        self.kinematics = kinematics
        self._fingers = fingers
        self._posture = gains.posture
        self._period_s = period_s
        # (joints,), rad: farthest that a target goes in a cycle.
        self._most = kinematics.limits.velocity * period_s
        self.wanted = np.zeros(len(self._most))  # (joints,), rad: targets of the last cycle
        # (joints,), rad: posture to which an undetermined joint tends.
        self._rest = self.wanted.copy()
        self._tips = np.zeros((len(kinematics.joints), 3))  # (fingers, 3), m: as sensed

    def start(self, position: Array) -> None:
        """Begin with targets, and a posture, at `position`, (joints,), rad."""
        self.wanted[:] = self._rest[:] = position

    def find_tips(self, position: Array) -> Array:
        """Take the joint positions sensed, (joints,), rad; return the tips, (fingers, 3), m, of
        this law's fingers."""
        self.kinematics.set_position(position)
        for finger in self._fingers:
            self._tips[finger] = self.kinematics.find_tip(finger)
        return self._tips

    def set_targets(self, grasp: GraspTarget, ahead_s: float, out: FingerTarget) -> None:
        """Fill a `FingerTarget` from a `GraspTarget`, taken on by `ahead_s` at its velocities;
        after `sense`."""
        before = self.wanted.copy()
        points = grasp.tip + ahead_s * grasp.tip_velocity
        reaching = []
        for finger in self._fingers:
            own = self.kinematics.joints[finger]
            mode = grasp.mode[finger]
            out.stiff[own] = 1.0
            out.torque[own] = 0.0
            out.spring[own] = 0.0
            if mode == FingerMode.JOINTS:
                self.wanted[own] = grasp.position[own] + ahead_s * grasp.velocity[own]
                self._rest[own] = self.wanted[own]
            elif mode == FingerMode.FORCE:
                jacobian = self.kinematics.find_jacobian(finger)
                out.torque[own] = transposed_mat_vec(jacobian, grasp.force[finger])
                out.spring[np.ix_(own, own)] = grasp.stiffness[finger] * gram(jacobian)
                out.stiff[own] = self._posture
            if mode != FingerMode.JOINTS:
                reaching.append(finger)
        if reaching:
            self._approach_points(reaching, points)
        moved = np.clip(self.wanted - before, -self._most, self._most)
        self.wanted[:] = before + moved
        for finger in self._fingers:
            own = self.kinematics.joints[finger]
            out.position[own] = self.wanted[own]
            out.velocity[own] = moved[own] / self._period_s

    def _approach_points(self, fingers: Sequence[int], points: Array) -> None:
        """Bring the targets of `fingers` closer to where their tips are at `points`, (fingers, 3),
        m."""
        for _ in range(STEPS):
            self.kinematics.set_position(self.wanted)
            for finger in fingers:
                own = self.kinematics.joints[finger]
                homing = HOMING * (self._rest[own] - self.wanted[own])
                self.kinematics.step_towards(
                    finger, self.wanted, points[finger] - self.kinematics.find_tip(finger), homing
                )


class JointGains(Table):
    """Gains of the joint loop."""

    bandwidth: Positive = Field(35.0, le=400.0)
    """natural frequency of the error in every joint, rad/s"""
    damping: Positive = Field(0.7, le=5.0)
    """damping ratio that the loop adds to the friction of joints"""
    ahead: NotNegative = Field(0.006, le=0.1)
    """time from a command of tensions until they have come, s"""


class JointLaw:
    """Sets the torques of some joints of a hand."""

    def __init__(self, cell: Cell, driven: Mask, gains: JointGains) -> None:
        """Drive the joints `driven`, (joints,)."""
        self._dynamics = Dynamics(cell)
        self._still = np.zeros(len(driven))
        viscous = cell.model.dof_damping[cell.dof]
        # In the rows of `set_joint_torques`.
        self._constants = np.array((self._dynamics.dry, viscous, cell.bounds.torque, driven))
        self._gains = gains.bandwidth**2, 2.0 * gains.damping * gains.bandwidth
        self._ahead = gains.ahead
        self._set = set_joint_torques.load()
        self.clipped = 0  # cycles in which a torque was cut to what the tendons can give

    def set_torques(
        self, hand: HandStatus, target: FingerTarget, age_s: float, ahead_s: float, out: Array
    ) -> None:
        """Set `out`, (joints,), N m, for when the sample in a `HandStatus` is `age_s` old; the
        `FingerTarget` is taken on by `ahead_s`."""
        terms = self._dynamics.terms(hand.position, self._still)
        is_cut = self._set(
            self._gains,
            (age_s + self._ahead, ahead_s),
            self._constants,
            numbers(hand, "position", "velocity").reshape(2, -1),
            numbers(target, "position", "torque").reshape(4, -1),
            target.spring,
            terms.inertia,
            terms.bias,
            out,
        )
        if is_cut:
            self.clipped += 1


@compiled_for(
    "UniTuple(f8, 2), UniTuple(f8, 2), f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], "
    "f8[:,::1], f8[::1], f8[::1]"
)
def set_joint_torques(
    gains: tuple[float, float],  # stiffness, 1/s2, and damping, 1/s
    times: tuple[float, float],  # s: by which the sample, and the target, are taken on
    constants: Array,  # (4, joints): rows as below
    state: Array,  # (2, joints): rad, rad/s
    wanted: Array,  # (4, joints): rad, rad/s, part of the stiffness, N m
    spring: Array,  # (joints, joints), N m/rad
    inertia: Array,  # (joints, joints), kg m2
    weight: Array,  # (joints,), N m
    torque: Array,  # (joints,), N m: set; 0 for joints of other boards
) -> bool:
    """Set the torques; return whether a limit cut one."""
    dry = constants[0]  # N m
    viscous = constants[1]  # N m s/rad
    limit = constants[2]  # N m
    driven = constants[3]  # 1: a joint of this board; 0: of another
    joints = len(torque)
    clipped = False
    for j in range(joints):
        torque[j] = 0.0
        if driven[j] != 0.0:
            friction = viscous[j] * wanted[1, j] + dry[j] * math.tanh(wanted[1, j] / FRICTION_SPEED)
            torque[j] = weight[j] + wanted[3, j] + friction
    for k in range(joints):
        if driven[k] == 0.0:
            continue
        away = wanted[0, k] + times[1] * wanted[1, k] - state[0, k] - times[0] * state[1, k]
        acceleration = gains[0] * wanted[2, k] * away + gains[1] * (wanted[1, k] - state[1, k])
        for j in range(joints):
            if driven[j] != 0.0:
                torque[j] += inertia[j, k] * acceleration + spring[j, k] * away
    for j in range(joints):
        if driven[j] != 0.0:
            needed = torque[j]
            torque[j] = np.minimum(np.maximum(needed, -limit[j]), limit[j])  # NaN stays
            clipped = clipped or needed != torque[j]
    return clipped


MOST_LEARNED = 0.1
"""Largest part of an error that one sample corrects, after however many that were missed."""


class TendonGains(Table):
    """What the law knows of the valves, and its gains."""

    lag: Positive = Field(0.008, le=1.0)
    """time constant of a valve, s"""
    lead: NotNegative = Field(1.0, le=4.0)
    """part of the tension still missing that is commanded in excess"""
    trim: NotNegative = Field(4.0, le=20.0)
    """rate at which a valve's lasting error is corrected, 1/s"""
    most_trim: NotNegative = 10.0
    """largest such correction, N"""
    margin: NotNegative = 1.0
    """tension kept above the hand's least, for a valve's error, N"""


class TendonLaw:
    """Sets the tensions of some joints of a hand. What it has learned of valves it learns anew
    after a restart."""

    def __init__(self, hand: Hand, driven: Mask, gains: TendonGains, context: LevelContext) -> None:
        """Drive the joints `driven`, (joints,), in every cycle of a level."""
        joints = len(driven)
        least = np.full(joints, hand.least + gains.margin)
        # In the rows of `set_tensions`.
        self._constants = np.array((hand.arms, least, hand.most, driven))
        self._numbers = (
            hand.rest,
            gains.lead,
            1.0 - math.exp(-context.period_s / gains.lag),
            gains.most_trim,
        )
        self._lag = gains.lag
        self._trim = gains.trim
        self._tick_s = context.tick_s
        self._valves = np.zeros((3, 2, joints))  # in the rows of `set_tensions`
        self._set = set_tensions.load()
        self._sampled = 0  # tick of the last sample
        self.clipped = 0  # cycles in which a torque was cut to what the tendons can give

    def start(self, status: HandStatus) -> None:
        """Begin with the tensions of a `HandStatus`."""
        self._valves[0] = status.wanted
        self._valves[1] = status.tension
        self._valves[2] = 0.0
        self._sampled = status.tick

    def set_tensions(self, status: HandStatus, torque: Array, out: Array) -> None:
        """Set `out`, (2, joints), N, for `torque`, (joints,), N m, at a `HandStatus`."""
        # Valves that are closed do not follow their commands: nothing is to be learned from them.
        elapsed = 0 if status.holding else status.tick - self._sampled
        self._sampled = status.tick
        elapsed_s = elapsed * self._tick_s
        shares = (
            1.0 - math.exp(-elapsed_s / self._lag),
            min(self._trim * elapsed_s, MOST_LEARNED),
        )
        sensed = numbers(status, "tension", "wanted")
        if self._set(self._numbers, shares, self._constants, self._valves, sensed, torque, out):
            self.clipped += 1


@compiled_for(
    "UniTuple(f8, 4), UniTuple(f8, 2), f8[:,::1], f8[:,:,::1], f8[::1], f8[::1], f8[:,::1]"
)
def set_tensions(
    # Mean tension, N, lead, share of a cycle in the lag, largest trim, N.
    numbers: tuple[float, float, float, float],
    shares: tuple[float, float],  # of the time since the sample before: in the lag, and in the trim
    constants: Array,  # (4, joints): rows as below
    valves: Array,  # (3, 2, joints), N: rows as below
    sensed: Array,  # (4 joints,), N: tensions as sensed, then as they were commanded; flexors first
    torque: Array,  # (joints,), N m
    tension: Array,  # (2, joints), N: set; 0 for joints of other boards
) -> bool:
    """Set the tensions; return whether a torque had to be clipped."""
    rest, lead, share, most_trim = numbers
    arm = constants[0]  # m
    least = constants[1]  # N
    most = constants[2]  # N
    driven = constants[3]  # 1: a joint of this board; 0: of another
    reached = valves[0]  # by the model, now
    expected = valves[1]  # by the model, at the sample
    trim = valves[2]  # correction
    joints = len(arm)
    clipped = False
    for j in range(joints):
        if driven[j] == 0.0:
            continue
        room = 0.5 * (most[j] - least[j])
        half = 0.5 * torque[j] / arm[j]
        if abs(half) > room:
            clipped = True
        half = np.minimum(np.maximum(half, -room), room)  # NaN stays
        mean = min(max(rest, least[j] + abs(half)), most[j] - abs(half))
        for row in range(2):
            wanted = mean + half if row == 0 else mean - half
            commanded = sensed[(2 + row) * joints + j] - trim[row, j]
            expected[row, j] += shares[0] * (commanded - expected[row, j])
            learned = trim[row, j] + shares[1] * (expected[row, j] - sensed[row * joints + j])
            if abs(learned) < np.inf:  # a NaN that was sensed teaches nothing
                trim[row, j] = min(max(learned, -most_trim), most_trim)
            early = wanted + lead * (wanted - reached[row, j])
            early = np.minimum(np.maximum(early, least[j]), most[j])
            reached[row, j] += share * (early - reached[row, j])
            tension[row, j] = np.minimum(np.maximum(early + trim[row, j], least[j]), most[j])
    return clipped
