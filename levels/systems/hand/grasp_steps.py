"""Execution of grasp steps: computes finger targets from the sensed fingers and object.

After a restart of its board, a step begins again at the current position of the fingers, with the
time for which it had already run. `run` returns True once the step is done, and raises `Refused` if
it has failed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rack.levels.algebra import Array, Ints, Mask, norm
from rack.levels.errors import Refused
from rack.levels.level import LevelContext, Reading
from rack.levels.messages import Error
from rack.levels.planning.pose import Pose
from rack.levels.systems.hand.grasp_program import (
    CloseStep,
    HoldStep,
    PreshapeStep,
    ReleaseStep,
    ShiftStep,
    SqueezeStep,
)
from rack.levels.systems.hand.grip import GripGains, HandGrip
from rack.levels.systems.hand.messages import FingerMode, FingerStatus, GraspTarget
from rack.levels.tables import NotNegative, Positive, Table

SLIPPED_PART = 0.2
"""Fraction of the touch force below which a tip no longer counts as touching."""


class FingersBelow:
    """State of all fingers, merged from the `FingerStatus` of each board.

    Points and forces are in the frame of the palm.
    """

    def __init__(self, context: LevelContext, fingers: Sequence[Ints]) -> None:
        """Start without statuses.

        Args:
            context: Context of the grasp level.
            fingers: Indices in `robot.joints` of the joints of each finger.
        """
        self._joints = fingers
        joints = context.sizes["joints"]
        count = len(fingers)
        self.position = np.zeros(joints)  # (joints,), rad: sensed
        self.target = np.zeros(joints)  # (joints,), rad: targets of the loops below
        self.tip = np.zeros((count, 3))  # m
        self.force = np.zeros((count, 3))  # N: of the environment on the tips
        self.awaited = ""  # why a finger does not follow, empty if all do
        self.error = Error.NONE  # error of the hand
        self.rests_on = 0  # serial of the newest operator command that all statuses reflect

    def read_statuses(self, statuses: Mapping[str, Reading[FingerStatus]]) -> None:
        """Merge the statuses of all boards."""
        self.awaited = ""
        self.error = Error.NONE
        for board, reading in statuses.items():
            status = reading.message
            if reading.is_lost or not reading.has_message:
                self.awaited = f"no status from '{board}': waiting for its board"
                continue
            if status.stopped and not self.awaited:
                self.awaited = f"{board}: {status.reason or 'it does not follow'}"
            self.error = self.error or Error(status.error)
            for finger in np.flatnonzero(status.driven).tolist():
                joints = self._joints[finger]
                self.position[joints] = status.position[joints]
                self.target[joints] = status.target[joints]
                self.tip[finger] = status.tip[finger]
                self.force[finger] = status.force[finger]
        self.rests_on = min(reading.message.operator for reading in statuses.values())


class GraspParams(GripGains):
    """`[board.<name>.params]` of a grasp loop."""

    astray: Positive = 0.03
    """largest position error of a joint in a posture [rad]"""
    patience: Positive = 1.0
    """time beyond its duration after which a step has failed [s]"""
    stalled: Positive = 60.0
    """duration of a suspension, except holds of an operator, that fails the program [s]"""
    most_added: NotNegative = 3.0
    """largest force that a workstation above may add to the grip force or take from it [N]"""
    lost: Positive = 0.2
    """time without contact after which a finger has lost the object [s]"""
    tolerance: Positive = 0.02
    """distance from its anchor at which a gripped object is lost [m]"""


@dataclass
class Grasp:
    """State that all steps share: sensed fingers, object, and targets.

    Points are in the frame of the palm.
    """

    params: GraspParams
    names: tuple[str, ...]  # names of the fingers
    joints: tuple[str, ...]
    postures: dict[str, Array]  # (joints,), rad, by name
    period_s: float
    fingers: FingersBelow
    target: GraspTarget  # filled by the steps
    grip: HandGrip
    touching: Mask  # (fingers,)
    close: CloseStep | None = None  # the step that gripped the object
    base: float = 0.0  # N: grip force without a load
    added: float = 0.0  # N: added to it by a workstation
    object: Pose | None = None  # sensed pose
    anchor: Array = field(default_factory=lambda: np.zeros(3))  # m: target position of the object
    moved: float = 0.0  # m: distance of the object from its anchor
    farthest: float = 0.0  # m: largest such distance since it was gripped

    @property
    def object_position(self) -> Array:
        """Sensed position of the object, (3,), in m, or its anchor if it is not sensed."""
        return self.anchor if self.object is None else self.object.position

    @property
    def missing_fingers(self) -> list[str]:
        """Names of the gripping fingers that do not touch the object."""
        return [self.names[finger] for finger in np.flatnonzero(self.grip.fingers & ~self.touching)]


class StepWork(ABC):
    """Execution of one step.

    Args:
        grasp: State that all steps share. The step fills `grasp.target`.
        step: The step of the program.
        resumed_s: Time for which the step was executed before a restart, s.
    """

    def __init__(self, grasp: Grasp, step: Any, resumed_s: float) -> None:
        self.grasp = grasp
        self.step = step
        self.resumed_s = resumed_s
        self.set_start()

    @abstractmethod
    def set_start(self) -> None:
        """Store the current state as the start of the step."""

    @abstractmethod
    def run(self, elapsed_s: float) -> bool:
        """Fill `grasp.target` for the current cycle.

        Args:
            elapsed_s: Time for which the step has run, in s.

        Returns:
            True if the step is done.

        Raises:
            Refused: The step has failed.
        """

    def find_progress(self, elapsed_s: float) -> tuple[float, float]:
        """Return the progress from `resumed_s` to the end, 0 to 1, and its rate in 1/s."""
        progress, rate = minimum_jerk(elapsed_s / self.step.seconds)
        before, _ = minimum_jerk(self.resumed_s / self.step.seconds)
        if before >= 1.0:
            return 1.0, 0.0
        return (progress - before) / (1.0 - before), rate / self.step.seconds / (1.0 - before)


def minimum_jerk(time: float) -> tuple[float, float]:
    """Return position, 0 to 1, and rate of a minimum-jerk motion that lasts from time 0 to 1.

    See Flash and Hogan, 1985.
    """
    x = min(max(time, 0.0), 1.0)
    return x * x * x * (10.0 - 15.0 * x + 6.0 * x * x), 30.0 * x * x * (1.0 - x) * (1.0 - x)


class PreshapeWork(StepWork):
    """Moves all joints to a posture, and ends when they have reached it."""

    step: PreshapeStep

    def set_start(self) -> None:
        """Start at the current joint targets."""
        self._start = self.grasp.fingers.target.copy()
        self._posture = self.grasp.postures[self.step.posture]

    def run(self, elapsed_s: float) -> bool:
        """Move the joints towards the posture. Returns True when they have reached it."""
        grasp = self.grasp
        target = grasp.target
        progress, rate = self.find_progress(elapsed_s)
        shift = self._posture - self._start
        target.mode[:] = FingerMode.JOINTS
        target.force[:] = 0.0
        target.position = self._start + progress * shift
        target.velocity = rate * shift
        if progress < 1.0:
            return False
        away = np.abs(grasp.fingers.position - self._posture)
        if (away < grasp.params.astray).all():
            return True
        if elapsed_s > self.step.seconds + grasp.params.patience:
            joint = int(away.argmax())
            far = (
                f"joint '{grasp.joints[joint]}' is {away[joint]:.2g} rad from posture"
                f" '{self.step.posture}'"
            )
            raise Refused(Error.FOLLOWING, f"{far}: it is in the way of something, or too weak")
        return False


class CloseWork(StepWork):
    """Moves the tips at constant speed towards points in the object until each touches it.

    A tip that touches the object stays there and presses.
    """

    step: CloseStep

    def set_start(self) -> None:
        """Start at the current tip positions."""
        grasp = self.grasp
        step = self.step
        self._start = grasp.fingers.tip.copy()
        self._displacements = np.zeros_like(self._start)  # (fingers, 3), m
        for name, point in step.points.items():
            finger = grasp.names.index(name)
            assert grasp.object is not None, "a step has begun without a world model"
            inside = grasp.object @ Pose(np.array(point), np.array([1.0, 0.0, 0.0, 0.0]))
            self._displacements[finger] = inside.position - self._start[finger]
        self._seconds = max(norm(shift) for shift in self._displacements) / step.speed
        # N: force of the opposing finger at which every finger presses with `step.touch` or more.
        self._touch = step.touch / min(grasp.grip.shares[grasp.grip.fingers])

    def run(self, elapsed_s: float) -> bool:
        """Move the tips that do not touch the object yet. Returns True when all touch it."""
        grasp = self.grasp
        target = grasp.target
        progress = min((elapsed_s - self.resumed_s) / self._seconds, 1.0)
        for finger in np.flatnonzero(grasp.grip.fingers & ~grasp.touching).tolist():
            shift = self._displacements[finger]
            if norm(grasp.fingers.force[finger]) >= self.step.touch:
                grasp.touching[finger] = True
                self._hold_contact(
                    finger, grasp.grip.shares[finger] * self._touch * shift / norm(shift)
                )
            else:
                target.mode[finger] = FingerMode.POINT
                target.tip[finger] = self._start[finger] + progress * shift
                target.tip_velocity[finger] = shift / self._seconds if progress < 1.0 else 0.0
        missing = grasp.missing_fingers
        at_the_end = elapsed_s - self.resumed_s > self._seconds + grasp.params.patience
        if missing and (at_the_end or elapsed_s > self.step.seconds):
            raise Refused(
                Error.GRASP_MISSED,
                f"missed '{self.step.object}': touched nothing: {', '.join(missing)}",
            )
        grasp.base = grasp.grip.force = self._touch
        return not missing

    def _hold_contact(self, finger: int, force: Array) -> None:
        """Keep a tip at its current position, as a spring that presses with `force`, (3,), in N."""
        grasp = self.grasp
        target = grasp.target
        target.mode[finger] = FingerMode.FORCE
        target.stiffness[finger] = grasp.grip.stiffness[finger]
        target.tip[finger] = grasp.fingers.tip[finger]
        target.tip_velocity[finger] = 0.0
        target.force[finger] = force


class GrippingWork(StepWork):
    """Base of the steps during which the fingers grip the object.

    It maintains the grip and detects its loss.
    """

    def set_start(self) -> None:
        """Assume that every finger is in contact at the start."""
        # (fingers,), s: time without contact.
        self._silent_s = np.zeros(len(self.grasp.names))

    def keep_grip(self) -> None:
        """Adapt the grip to the load and apply it. Raises `Refused` if the object is lost."""
        grasp = self.grasp
        fingers = grasp.fingers
        away = grasp.object_position - grasp.anchor
        grasp.moved = norm(away)
        grasp.farthest = max(grasp.farthest, grasp.moved)
        grasp.grip.follow_creep(grasp.target.tip, fingers.tip)
        grasp.grip.correct_position(away)
        grasp.grip.adapt_force(max(grasp.base + grasp.added, 0.0), fingers.force)
        self.apply_grip()

    def apply_grip(self) -> None:
        """Set the target forces to those of the grip. Raises `Refused` if the object is lost."""
        grasp = self.grasp
        params = grasp.params
        close = grasp.close
        grasp.target.force = grasp.grip.find_forces(grasp.fingers.tip)
        assert close is not None, "checked with the program"
        felt = np.array([norm(force) for force in grasp.fingers.force])
        silent = felt < SLIPPED_PART * close.touch
        self._silent_s = np.where(silent, self._silent_s + grasp.period_s, 0.0)
        grasp.touching[:] = grasp.grip.fingers & (self._silent_s < params.lost)
        if missing := grasp.missing_fingers:
            raise Refused(
                Error.OBJECT_LOST,
                f"lost '{close.object}': no longer touched by {', '.join(missing)}",
            )
        if grasp.moved > params.tolerance:
            far = (
                f"{1e3 * grasp.moved:.1f} mm from its place; permitted:"
                f" {1e3 * params.tolerance:g} mm"
            )
            raise Refused(Error.OBJECT_LOST, f"lost '{close.object}': {far}")


class SqueezeWork(GrippingWork):
    """Raises the grip force.

    The object settles between the fingers. Its position at the end of the step becomes its anchor,
    the position at which later steps keep it.
    """

    step: SqueezeStep

    def set_start(self) -> None:
        """Start with the current grip force."""
        super().set_start()
        self._from = self.grasp.base

    def run(self, elapsed_s: float) -> bool:
        """Set the grip force for `elapsed_s`. Returns True when it has reached `step.grip`."""
        grasp = self.grasp
        progress, _ = self.find_progress(elapsed_s)
        grasp.anchor[:] = grasp.object_position
        grasp.base = grasp.grip.force = self._from + progress * (self.step.grip - self._from)
        self.apply_grip()
        return progress >= 1.0


class ShiftWork(GrippingWork):
    """Moves the anchor of the object and the points of the tips by `step.by`, in the palm frame."""

    step: ShiftStep

    def set_start(self) -> None:
        """Compute the remaining displacement, which is shorter than `step.by` after a restart."""
        super().set_start()
        done, _ = minimum_jerk(self.resumed_s / self.step.seconds)
        self._displacement = (1.0 - done) * np.array(self.step.by)
        self._progress = 0.0

    def run(self, elapsed_s: float) -> bool:
        """Shift the anchor and the tips. Returns True when the shift is complete."""
        grasp = self.grasp
        target = grasp.target
        progress, rate = self.find_progress(elapsed_s)
        gone = (progress - self._progress) * self._displacement
        self._progress = progress
        grasp.anchor += gone
        target.tip[grasp.grip.fingers] += gone
        target.tip_velocity[grasp.grip.fingers] = rate * self._displacement
        self.keep_grip()
        return progress >= 1.0


class HoldWork(GrippingWork):
    """Holds the object in place."""

    step: HoldStep

    def run(self, elapsed_s: float) -> bool:
        """Hold the object. Returns True after `step.seconds`."""
        self.keep_grip()
        return elapsed_s >= self.step.seconds


class ReleaseWork(StepWork):
    """Reduces the forces to zero in the first half of its time, then withdraws the tips."""

    step: ReleaseStep

    def set_start(self) -> None:
        """Start with the current forces and tip positions."""
        grasp = self.grasp
        self._force = grasp.grip.force
        self._load = grasp.grip.load.copy()
        self._start = grasp.fingers.tip.copy()
        self._out = grasp.grip.find_outward_directions(grasp.fingers.tip)

    def run(self, elapsed_s: float) -> bool:
        """Reduce the forces, then withdraw the tips. Returns True when they are withdrawn."""
        grasp = self.grasp
        target = grasp.target
        half = 0.5 * self.step.seconds
        if elapsed_s < half:
            left = 1.0 - elapsed_s / half
            grasp.grip.force = left * self._force
            grasp.grip.load[:] = left * self._load
            target.force = grasp.grip.find_forces(grasp.fingers.tip)
            self._start[:] = target.tip
            return False
        progress, rate = minimum_jerk(elapsed_s / half - 1.0)
        grasp.grip.force = 0.0
        grasp.grip.load[:] = 0.0
        grasp.touching[:] = False
        for finger in np.flatnonzero(grasp.grip.fingers):
            shift = self.step.way * self._out[finger]
            target.mode[finger] = FingerMode.POINT
            target.force[finger] = 0.0
            target.tip[finger] = self._start[finger] + progress * shift
            target.tip_velocity[finger] = rate / half * shift
        return progress >= 1.0


WORKS: dict[type[Table], type[StepWork]] = {
    PreshapeStep: PreshapeWork,
    CloseStep: CloseWork,
    SqueezeStep: SqueezeWork,
    ShiftStep: ShiftWork,
    HoldStep: HoldWork,
    ReleaseStep: ReleaseWork,
}
"""Dictionary from the class of a step to the class that executes it."""
