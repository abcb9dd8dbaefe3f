"""Control laws of a hand, for fingertips, joints and tendons.

The fingertip law computes joint targets. Each finger is in one of three modes:

- JOINTS: the targets are commanded directly.
- POINT: the targets follow by inverse kinematics, with a few damped steps per cycle.
- FORCE: torque = J^T force + J^T k J (joints at the point - joints), an isotropic spring of
  stiffness k about a point (Salisbury, "Active stiffness control of a manipulator in Cartesian
  coordinates", 1980). The joint stiffness J^T k J is passed to the joint loop, because the spring
  is stable at a higher stiffness if it is closed at the rate of that loop. The joint loop also
  damps the spring, and a small part of its stiffness keeps the posture, since the position of the
  tip leaves one joint of a finger undetermined.

The joint law computes torques with which the error of every joint behaves like a damped oscillator
of the desired stiffness.

torque = M(q) (2 d w (qd_wanted - qd) + s w^2 e) + S e + torque of tip forces + weight(q) +
friction(qd_wanted)

e = q_wanted - q. `s`, 0 to 1 for each joint, scales the stiffness; S is the stiffness of tips in
mode FORCE. The damping always acts, so that a finger which only exerts a force moves slowly. The
weight of a finger is small, but would displace a soft joint by degrees. Viscous friction is fed
forward for the target velocity, not the sensed one, so that its damping is not cancelled. The
sample is extrapolated at the sensed velocity to the time at which the torque acts, including the
lag of a valve.

The tendon law computes tensions for a torque. It compensates the lag of the valves and their
lasting errors.

A pair of tendons turns its joint with torque = a (Tf - Te), where a is the moment arm. For a mean
tension T0, Tf = T0 + torque / 2a and Te = T0 - torque / 2a. Tendons can only pull: if one would
become slack, the mean is raised; if the other then exceeds its limit, the torque is clipped.

A valve follows its command with a first-order lag (assumed). `lead` commands an excess tension
while the tension of a model of the valve has not arrived, which makes the response (1 + lead) times
as fast. It uses no feedback, so delays to and from the hand cannot make it unstable. Gain and
offset errors of a valve remain; `trim` integrates the difference between the sensed tension and the
model, much more slowly than the lag. The model for this uses the commands that the hand reports
with each sample, so both belong to the same time.
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
from rack.levels.servo.arm_report import view_numbers
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.messages import FingerMode, FingerTarget, GraspTarget, HandStatus
from rack.levels.tables import NotNegative, Positive, Table

HOMING = 0.02
"""Fraction of the distance to its posture by which a redundant joint moves in a step."""
STEPS = 2
"""Steps of inverse kinematics per cycle."""


class FingertipGains(Table):
    """Gains of the fingertip loop."""

    posture: NotNegative = Field(0.2, le=1.0)
    """fraction of the joint loop's stiffness that keeps the posture of a finger in mode FORCE"""


class FingertipLaw:
    """Computes the joint targets of some fingers of a hand."""

    def __init__(
        self,
        kinematics: FingerKinematics,
        fingers: Sequence[int],
        gains: FingertipGains,
        period_s: float,
    ) -> None:
        """Start at zero targets; call `start` before the first cycle.

        Args:
            kinematics: Kinematics of the whole hand.
            fingers: Indices of the fingers to drive.
            gains: Gains of the law.
            period_s: Time between two cycles, s.
        """
        self.kinematics = kinematics
        self._fingers = fingers
        self._posture = gains.posture
        self._period_s = period_s
        # (joints,), rad: largest change of a target in a cycle.
        self._most_motion = kinematics.limits.velocity * period_s
        self.wanted = np.zeros(len(self._most_motion))  # (joints,), rad: targets of the last cycle
        # (joints,), rad: posture to which a redundant joint returns.
        self._rest = self.wanted.copy()
        self._tips = np.zeros((len(kinematics.joints), 3))  # (fingers, 3), m: sensed

    def start(self, position: Array) -> None:
        """Set targets and posture to `position`, (joints,), in rad."""
        self.wanted[:] = self._rest[:] = position

    def find_tips(self, position: Array) -> Array:
        """Return the tip positions of the driven fingers at sensed joint positions.

        Args:
            position: Joint positions, (joints,), rad.

        Returns:
            Positions of the tips, (fingers, 3), m.
        """
        self.kinematics.set_position(position)
        for finger in self._fingers:
            self._tips[finger] = self.kinematics.find_tip(finger)
        return self._tips

    def set_targets(self, grasp: GraspTarget, ahead_s: float, out: FingerTarget) -> None:
        """Fill a `FingerTarget` from a `GraspTarget`. Call `find_tips` first.

        Args:
            grasp: The command, which is extrapolated at its velocities.
            ahead_s: Time by which it is extrapolated, s.
            out: Joint targets; the elements of the driven fingers are set.
        """
        before = self.wanted.copy()
        points = grasp.tip + ahead_s * grasp.tip_velocity
        reaching = []
        for finger in self._fingers:
            joints = self.kinematics.joints[finger]
            mode = grasp.mode[finger]
            out.stiff[joints] = 1.0
            out.torque[joints] = 0.0
            out.spring[joints] = 0.0
            if mode == FingerMode.JOINTS:
                self.wanted[joints] = grasp.position[joints] + ahead_s * grasp.velocity[joints]
                self._rest[joints] = self.wanted[joints]
            elif mode == FingerMode.FORCE:
                jacobian = self.kinematics.find_jacobian(finger)
                out.torque[joints] = transposed_mat_vec(jacobian, grasp.force[finger])
                out.spring[np.ix_(joints, joints)] = grasp.stiffness[finger] * gram(jacobian)
                out.stiff[joints] = self._posture
            if mode != FingerMode.JOINTS:
                reaching.append(finger)
        if reaching:
            self._approach_points(reaching, points)
        moved = np.clip(self.wanted - before, -self._most_motion, self._most_motion)
        self.wanted[:] = before + moved
        for finger in self._fingers:
            joints = self.kinematics.joints[finger]
            out.position[joints] = self.wanted[joints]
            out.velocity[joints] = moved[joints] / self._period_s

    def _approach_points(self, fingers: Sequence[int], points: Array) -> None:
        """Move the joint targets of `fingers` so that their tips approach the given points.

        Args:
            fingers: Indices of the fingers.
            points: Points of all fingers, (fingers, 3), m.
        """
        for _ in range(STEPS):
            self.kinematics.set_position(self.wanted)
            for finger in fingers:
                joints = self.kinematics.joints[finger]
                homing = HOMING * (self._rest[joints] - self.wanted[joints])
                self.kinematics.step_towards(
                    finger, self.wanted, points[finger] - self.kinematics.find_tip(finger), homing
                )


class JointGains(Table):
    """Gains of the joint loop."""

    bandwidth: Positive = Field(35.0, le=400.0)
    """natural frequency of the error in every joint [rad/s]"""
    damping: Positive = Field(0.7, le=5.0)
    """damping ratio of the loop, in addition to the friction of joints"""
    ahead: NotNegative = Field(0.006, le=0.1)
    """time from a command until the tensions have followed it [s]"""


class JointLaw:
    """Computes the torques of some joints of a hand."""

    def __init__(self, cell: Cell, driven: Mask, gains: JointGains) -> None:
        """Drive the joints selected by the mask `driven`, (joints,)."""
        self._dynamics = Dynamics(cell)
        self._still = np.zeros(len(driven))
        viscous = cell.model.dof_damping[cell.dof]
        # Rows as in the parameter `constants` of `set_joint_torques`.
        self._constants = np.array((self._dynamics.dry, viscous, cell.bounds.torque, driven))
        self._gains = gains.bandwidth**2, 2.0 * gains.damping * gains.bandwidth
        self._ahead = gains.ahead
        self._set = set_joint_torques.load_machine_code()
        self.clipped = 0  # cycles in which a torque was limited

    def set_torques(
        self, hand: HandStatus, target: FingerTarget, age_s: float, ahead_s: float, out: Array
    ) -> None:
        """Compute the joint torques from the newest sample and the targets.

        Args:
            hand: Status with the newest sample.
            target: Joint targets.
            age_s: Age of the sample when the torque acts, s.
            ahead_s: Time by which the target is extrapolated, s.
            out: Torques, (joints,), N m; filled.
        """
        terms = self._dynamics.terms(hand.position, self._still)
        is_cut = self._set(
            self._gains,
            (age_s + self._ahead, ahead_s),
            self._constants,
            view_numbers(hand, "position", "velocity").reshape(2, -1),
            view_numbers(target, "position", "torque").reshape(4, -1),
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
    gains: tuple[float, float],
    times: tuple[float, float],
    constants: Array,
    state: Array,
    wanted: Array,
    spring: Array,
    inertia: Array,
    weight: Array,
    torque: Array,
) -> bool:
    """Compute the torques of the driven joints.

    Args:
        gains: Stiffness, 1/s2, and damping, 1/s.
        times: Times by which the sample and the target are extrapolated, s.
        constants: Dry friction, viscous friction, torque limit and mask of the joints, (4, joints).
        state: Sensed positions and velocities, (2, joints).
        wanted: Target position, target velocity, scale of the stiffness and feedforward torque, (4,
            joints).
        spring: Stiffness of the grip, (joints, joints), N m/rad.
        inertia: Inertia matrix, (joints, joints), kg m2.
        weight: Torques that compensate gravity, (joints,), N m.
        torque: Torques, (joints,), N m; filled, with 0 for joints of other boards.

    Returns:
        True if a torque was limited.
    """
    dry = constants[0]  # N m
    viscous = constants[1]  # N m s/rad
    limit = constants[2]  # N m
    driven = constants[3]  # 1 for the joints of this board
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
"""Largest fraction of an error that one sample corrects, no matter how many were missed
before it."""


class TendonGains(Table):
    """Model of the valves, and gains of the tendon law."""

    lag: Positive = Field(0.008, le=1.0)
    """time constant of a valve [s]"""
    lead: NotNegative = Field(1.0, le=4.0)
    """excess command, as a fraction of the tension that has not arrived"""
    trim: NotNegative = Field(4.0, le=20.0)
    """rate of correction of a valve's lasting error [1/s]"""
    most_trim: NotNegative = 10.0
    """largest correction [N]"""
    margin: NotNegative = 1.0
    """margin above the hand's least tension for errors of a valve [N]"""


class TendonLaw:
    """Computes the tensions for some joints of a hand.

    The learned corrections of the valves are not saved, therefore a restarted board learns them
    again.
    """

    def __init__(self, hand: Hand, driven: Mask, gains: TendonGains, context: LevelContext) -> None:
        """Drive the joints selected by the mask `driven`, (joints,), in every cycle of a level."""
        joints = len(driven)
        least = np.full(joints, hand.least + gains.margin)
        # Rows as in the parameter `constants` of `set_tensions`.
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
        self._valves = np.zeros((3, 2, joints))  # rows as in `set_tensions`
        self._set = set_tensions.load_machine_code()
        self._sampled = 0  # tick of the last sample
        self.clipped = 0  # cycles in which a torque was limited

    def start(self, status: HandStatus) -> None:
        """Initialise the models with the tensions of a `HandStatus`."""
        self._valves[0] = status.wanted
        self._valves[1] = status.tension
        self._valves[2] = 0.0
        self._sampled = status.tick

    def set_tensions(self, status: HandStatus, torque: Array, out: Array) -> None:
        """Compute the tendon tensions from the newest sample and the torques.

        Args:
            status: Status with the newest sample.
            torque: Torques to exert, (joints,), N m.
            out: Tensions, (2, joints), N; filled.
        """
        # Closed valves do not follow their commands, so nothing can be learned from them.
        elapsed = 0 if status.holding else status.tick - self._sampled
        self._sampled = status.tick
        elapsed_s = elapsed * self._tick_s
        shares = (
            1.0 - math.exp(-elapsed_s / self._lag),
            min(self._trim * elapsed_s, MOST_LEARNED),
        )
        sensed = view_numbers(status, "tension", "wanted")
        if self._set(self._numbers, shares, self._constants, self._valves, sensed, torque, out):
            self.clipped += 1


@compiled_for(
    "UniTuple(f8, 4), UniTuple(f8, 2), f8[:,::1], f8[:,:,::1], f8[::1], f8[::1], f8[:,::1]"
)
def set_tensions(
    numbers: tuple[float, float, float, float],
    shares: tuple[float, float],
    constants: Array,
    valves: Array,
    sensed: Array,
    torque: Array,
    tension: Array,
) -> bool:
    """Compute the tensions of the driven joints.

    Args:
        numbers: Mean tension, N; lead; response of a valve in a cycle, 0 to 1; largest trim, N.
        shares: Responses of a valve and of the trim since the last sample, 0 to 1.
        constants: Lever arm, least and largest tension, and mask of the joints, (4, joints).
        valves: Modelled tensions now and at the sample, and trim, (3, 2, joints), N; modified in
            place.
        sensed: Sensed, then commanded tensions, flexors first, (4 * joints,), N.
        torque: Torques, (joints,), N m.
        tension: Tensions, (2, joints), N; filled, with 0 for joints of other boards.

    Returns:
        True if a torque had to be clipped.
    """
    rest, lead, share, most_trim = numbers
    arm = constants[0]  # m
    least = constants[1]  # N
    highest = constants[2]  # N
    driven = constants[3]  # 1 for the joints of this board
    reached = valves[0]  # modelled tensions now
    expected = valves[1]  # modelled tensions at the sample
    trim = valves[2]  # correction
    joints = len(arm)
    clipped = False
    for j in range(joints):
        if driven[j] == 0.0:
            continue
        room = 0.5 * (highest[j] - least[j])
        half = 0.5 * torque[j] / arm[j]
        if abs(half) > room:
            clipped = True
        half = np.minimum(np.maximum(half, -room), room)  # NaN stays
        mean = min(max(rest, least[j] + abs(half)), highest[j] - abs(half))
        for row in range(2):
            wanted = mean + half if row == 0 else mean - half
            commanded = sensed[(2 + row) * joints + j] - trim[row, j]
            expected[row, j] += shares[0] * (commanded - expected[row, j])
            learned = trim[row, j] + shares[1] * (expected[row, j] - sensed[row * joints + j])
            if abs(learned) < np.inf:  # ignore a sensed NaN
                trim[row, j] = min(max(learned, -most_trim), most_trim)
            early = wanted + lead * (wanted - reached[row, j])
            early = np.minimum(np.maximum(early, least[j]), highest[j])
            reached[row, j] += share * (early - reached[row, j])
            tension[row, j] = np.minimum(np.maximum(early + trim[row, j], least[j]), highest[j])
    return clipped
