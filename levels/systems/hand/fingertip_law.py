"""The law of the fingertips: joint targets from what is wanted of the fingers, each in one of three
modes.

JOINTS: the targets are those given. POINT: inverse kinematics, a few damped steps a cycle from the
targets before. FORCE: torque = J^T force + J^T k J (joints at the point - joints), a spring of
stiffness k about a point, the same in all directions (Salisbury, "Active stiffness control of a
manipulator in Cartesian coordinates", 1980). The stiffness by joints, J^T k J, goes to the joint
loop: closed at its rate the spring is stable at a stiffness at which, closed at the rate of this
loop, it is not. The joint loop also damps it, and a small part of its own stiffness keeps the
posture: the tip leaves one joint of a finger undetermined.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import Field

from rack.backplane.message import Message
from rack.levels.algebra import Array, gram, transposed_mat_vec
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.messages import FingerMode
from rack.levels.tables import NotNegative, Table

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

    def sense(self, position: Array) -> Array:
        """Take the joint positions sensed, (joints,), rad; return the tips, (fingers, 3), m, of
        this law's fingers."""
        self.kinematics.look(position)
        for finger in self._fingers:
            self._tips[finger] = self.kinematics.tip(finger)
        return self._tips

    def targets(self, grasp: Message, ahead_s: float, out: Message) -> None:
        """Fill a `FINGER_TARGET` from a `GRASP_TARGET`, taken on by `ahead_s` at its velocities;
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
                jacobian = self.kinematics.jacobian(finger)
                out.torque[own] = transposed_mat_vec(jacobian, grasp.force[finger])
                out.spring[np.ix_(own, own)] = grasp.stiffness[finger] * gram(jacobian)
                out.stiff[own] = self._posture
            if mode != FingerMode.JOINTS:
                reaching.append(finger)
        if reaching:
            self._reach(reaching, points)
        moved = np.clip(self.wanted - before, -self._most, self._most)
        self.wanted[:] = before + moved
        for finger in self._fingers:
            own = self.kinematics.joints[finger]
            out.position[own] = self.wanted[own]
            out.velocity[own] = moved[own] / self._period_s

    def _reach(self, fingers: Sequence[int], points: Array) -> None:
        """Bring the targets of `fingers` closer to where their tips are at `points`, (fingers, 3),
        m."""
        for _ in range(STEPS):
            self.kinematics.look(self.wanted)
            for finger in fingers:
                own = self.kinematics.joints[finger]
                homing = HOMING * (self._rest[own] - self.wanted[own])
                self.kinematics.step(
                    finger, self.wanted, points[finger] - self.kinematics.tip(finger), homing
                )
