"""Faults between the servo level and its arm: samples on their way up, torques on their way down, motors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rack.levels.arm.arm import Arm, Sensed
from rack.levels.level import Fault, Finding
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import FRICTION_SPEED
from rack.levels.robot.limits import MAX_CONTACT_PART, MAX_RESTING_CONTACT_PART, MIN_TURNING_JOINTS

Array = NDArray[np.float64]

SENSOR_KINDS = ("sensor-nan", "sensor-stuck", "sensor-dropout", "sensor-bias", "sensor-noise")
MOTOR_KINDS = ("actuator-off", "actuator-saturated")
COMMAND_KINDS = ("command-nan", "command-limit")
KINDS = SENSOR_KINDS + MOTOR_KINDS + COMMAND_KINDS

APART = np.array([1e-2, 1e-2])
"""Distance from the truth, rad and rad/s, from which on a sensor that is stuck is counted as wrong: while a joint only
creeps, that need not be noticed before it has come that far."""
SLIGHT = 0.02
"""Part of its torque limit that a motor must lack to count, beside what dry friction and a contact may hide."""
TURNS_FROM = 5.0 * FRICTION_SPEED
"""Velocity, rad/s, from which on the dry friction of a joint is known."""


class _Active(NamedTuple):
    """An injected fault: `place` among those injected, `joints` (joints,), True where it strikes."""

    place: int
    fault: Fault
    joints: NDArray[np.bool_]

    @property
    def part(self) -> float:
        """Part of its torque limit that a motor still gives."""
        return self.fault.parameters["part"] if self.fault.kind == "actuator-saturated" else 0.0

    @property
    def key(self) -> tuple[str, int, int, int]:
        """What tells it from the others, also when the set of them changes."""
        return (self.fault.kind, self.fault.seed, self.fault.since, int(self.joints.argmax()))

    def draw(self, tick: int) -> np.random.Generator:
        """Return the random numbers of one tick: a board that starts anew draws the same."""
        return np.random.default_rng((self.fault.seed, tick))


class FaultyLink:
    """Implements `Link` with faults in it.

    `acted` collects the places of the faults that act, as `Executor.acted` wants them.
    """

    def __init__(self, arm: Arm, cell: Cell, every: int, acted: list[int]) -> None:
        """Lie between the servo level, which cycles `every` ticks, and the `arm` of a cell."""
        self._arm, self._every, self._acted = arm, every, acted
        self._limits = limits = cell.bounds.torque
        # Friction that helped may now resist: it hides twice its value.
        self._hidden = SLIGHT * limits + 2.0 * cell.model.dof_frictionloss[cell.dof]
        # What carried may now press.
        self._pressed = 2.0 * MAX_CONTACT_PART * limits
        self._sensors: list[_Active] = []
        self._motors: list[_Active] = []
        self._commands: list[_Active] = []
        self._frozen: dict[tuple[str, int, int, int], Sensed] = {}
        self._torque = np.zeros(len(limits))

    def inject(self, faults: Sequence[Fault]) -> None:
        """Take over all faults that are active from now on; a joint that the arm lacks is never struck."""
        active = [_Active(place, fault, self._joints(fault)) for place, fault in enumerate(faults)]
        self._sensors = [a for a in active if a.fault.kind in SENSOR_KINDS]
        self._motors = [a for a in active if a.fault.kind in MOTOR_KINDS]
        self._commands = [a for a in active if a.fault.kind in COMMAND_KINDS]
        kept = {a.key for a in active}
        self._frozen = {key: sample for key, sample in self._frozen.items() if key in kept}
        self._arm.weaken(self._most() if self._motors else None)

    def _joints(self, fault: Fault) -> NDArray[np.bool_]:
        joint = int(fault.parameters.get("joint", -1))
        return np.full(len(self._limits), True) if joint < 0 else np.arange(len(self._limits)) == joint

    def _most(self) -> Array:
        most = np.full(len(self._limits), np.inf)
        for active in self._motors:
            np.minimum(most, active.part * self._limits, out=most, where=active.joints)
        return most

    def sense(self) -> Sensed:
        """Return the newest sample, with what is wrong with it."""
        sample = self._arm.sense()
        for active in self._sensors:
            sample, acts = self._spoil(sample, active)
            if acts:
                self._acted.append(active.place)
        return sample

    def _spoil(self, sample: Sensed, active: _Active) -> tuple[Sensed, bool]:
        """Return the sample as one fault leaves it, and whether that can be told from the truth."""
        _, fault, joints = active
        position = sample.position
        match fault.kind:
            case "sensor-nan":
                return sample._replace(position=np.where(joints, np.nan, position)), bool(joints.any())
            case "sensor-bias":
                bias = fault.parameters["size"] * joints
                return sample._replace(position=position + bias), bool(joints.any())
            case "sensor-noise":
                noise = fault.parameters["size"] * active.draw(sample.tick).standard_normal(len(joints))
                return sample._replace(position=position + noise * joints), bool(joints.any())
            case "sensor-dropout":
                # The last sample was that of the cycle before. Nobody looks at the values of an old one.
                frozen = self._freeze(sample, active)
                return frozen._replace(tick=frozen.tick - self._every), True
        frozen = self._freeze(sample, active)
        stuck = np.where(joints, (frozen.position, frozen.velocity), (position, sample.velocity))
        apart = np.abs(stuck - (position, sample.velocity)) > APART[:, None]
        return sample._replace(position=stuck[0], velocity=stuck[1]), bool(apart.any())

    def _freeze(self, sample: Sensed, active: _Active) -> Sensed:
        """Return the sample with which the fault began."""
        if active.key not in self._frozen:
            copy = sample._replace(position=sample.position.copy(), velocity=sample.velocity.copy())
            self._frozen[active.key] = copy
        return self._frozen[active.key]

    def drive(self, torque: Array, grip_force: float) -> Finding | None:
        """Give torques as the faults leave them."""
        if self._commands:
            torque = self._corrupt(torque)
        found = self._arm.drive(torque, grip_force)
        if self._motors and not self._arm.braked:
            asked = np.abs(self._arm.torque)
            hidden = self._hidden + self._pushed()
            for active in self._motors:
                lacking = asked - active.part * self._limits
                if (lacking > hidden)[active.joints].any():
                    self._acted.append(active.place)
        return found

    def _pushed(self) -> Array | float:
        """Return what a push may hide of what a motor lacks, N m."""
        if self._arm.leans:
            return self._pressed
        turning = np.count_nonzero(np.abs(self._arm.sense().velocity) > TURNS_FROM)
        return MAX_RESTING_CONTACT_PART * self._limits if self._arm.holds and turning < MIN_TURNING_JOINTS else 0.0

    def _corrupt(self, torque: Array) -> Array:
        corrupt = self._torque
        np.copyto(corrupt, torque)
        for place, fault, joints in self._commands:
            if fault.kind == "command-nan":
                corrupt[joints] = np.nan
            else:
                beyond = fault.parameters["factor"] * np.copysign(self._limits, torque)
                np.copyto(corrupt, beyond, where=joints)
            self._acted.append(place)
        return corrupt
