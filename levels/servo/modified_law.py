"""A servo law with control modifications, which are switched without a step in the torque.

In the first sample after a switch the torque does not change. The difference from the torque of the
newly modified law decays to zero, with zero slope at both ends, while the new law is already
active. A switch therefore adds only this difference, whatever the modifications compute. Torque
limits apply to the sum.

Two alternatives were rejected. Evaluating the old and the new law in one sample would run a
modification with state twice. A ramp of gains would need to know the internals of the law.

A modification that raises an exception, or whose result is not finite, is undone and switched off
in the same sample, with the same smooth change of the torque.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.level import Finding, LevelContext
from rack.levels.servo.curves import Motion
from rack.levels.servo.modification import (
    Hook,
    LawContext,
    LawSample,
    ModifiableParams,
    Modification,
)

Law = Callable[[Motion, Array], Array]
"""Returns torques, (joints,), N m, for a wanted motion at a state, (2, joints), rad, rad/s."""


@dataclass
class ModificationState:
    """One modification of a law, switched on or off."""

    number: int
    name: str
    modification: Modification
    is_on: bool
    begins: bool = True  # the next sample is the first after it was switched on

    def apply_to(self, sample: LawSample, changed: Array) -> str:
        """Apply the modification to a sample. Undo it if it fails.

        Args:
            sample: Sample of the law.
            changed: Array of the sample that the modification may change.

        Returns:
            Why the modification failed, or an empty string if it did not.
        """
        original = changed.copy()
        try:
            if self.begins:
                self.begins = False
                self.modification.begin(sample)
            self.modification.modify(sample)
            failure = "" if np.isfinite(changed).all() else "its result is not finite"
        # Code of users may raise any exception.
        except Exception as error:
            failure = f"{type(error).__name__}: {error}"
        if failure:
            changed[:] = original
        return failure


class ModifiedLaw:
    """Applies control modifications to one law.

    Attributes:
        has_modifications: True if the config declares modifications, switched on or off. Otherwise
            the law may be called directly.
        reason: Names of the active modifications, and why others have failed.
    """

    def __init__(
        self,
        context: LevelContext,
        params: ModifiableParams,
        torque: Array,
        findings: list[Finding],
    ) -> None:
        """Create the modifications that the parameters declare.

        Args:
            context: Context of the level.
            params: Parameters of the board.
            torque: Torque limits, (joints,), N m.
            findings: List to which failures of modifications are added.
        """
        joints = context.robot.joints
        period_s = context.period_s
        self.has_modifications = bool(params.modifications)
        self._all = {
            name: ModificationState(
                number,
                name,
                entry.kind(LawContext(joints, period_s, torque, entry.params)),
                entry.on,
            )
            for number, (name, entry) in enumerate(params.modifications.items())
        }
        self._ticks = max(round(params.transfer / context.tick_s), context.every)
        self._torque = torque
        self._findings = findings
        self._sample = LawSample(len(joints))
        self._last = np.zeros(len(joints))  # N m: torque of the last sample
        # N m: torque before the last switch, minus the torque of the law after it.
        self._difference = np.zeros(len(joints))
        self._since: int | None = None  # tick of the switch, None once the difference has decayed
        self._is_driving = False  # the last sample's torque was given to the arm
        self._switched = False  # a modification was switched after the last sample
        self._failed: dict[str, str] = {}  # reason of each failure, by name
        self._update_hooks()

    def switch_modification(self, name: str, is_on: bool) -> str:
        """Switch a modification on or off from the next sample.

        Args:
            name: Name of the modification.
            is_on: True to switch it on.

        Returns:
            Why the switch is refused, or an empty string.
        """
        state = self._all.get(name)
        if state is None:
            return f"no modification '{name}'; permitted: {', '.join(self._all) or 'none'}"
        if is_on != state.is_on or state.name in self._failed:
            self._failed.pop(state.name, None)
            if is_on and state.modification.hook == Hook.INSTEAD:
                for other in self._instead:
                    other.is_on = False
            state.is_on = state.begins = is_on
            self._update_hooks()
        return ""

    def forget_torque(self) -> None:
        """Forget the last torque of an arm that is now braked. The next switch is not blended."""
        self._is_driving = False

    def compute_torque(
        self, law: Law, wanted: Motion, state: Array, inertia: Array, load: Array, tick: int
    ) -> Array:
        """Return the torques of the law with all active modifications applied.

        Args:
            law: Unmodified law.
            wanted: Motion to follow.
            state: Sensed positions and velocities, (2, joints), rad, rad/s.
            inertia: Diagonal of the joint-space inertia, (joints,), kg m2.
            load: Torques of gravity and velocities, (joints,), N m.
            tick: Tick of the sample.

        Returns:
            Torques, (joints,), N m. The array is valid until the next call.
        """
        sample = self._sample
        sample.tick = tick
        sample.inertia = inertia
        sample.load = load
        sample.seen[:3] = wanted.table
        sample.seen[3:] = state
        torque = sample.torque
        torque[:] = np.nan
        for before in self._before:
            self._apply_modification(before, sample.seen)
        if not any(self._apply_modification(instead, torque) for instead in self._instead):
            torque[:] = law(sample.motion, sample.seen[3:])
        for after in self._after:
            self._apply_modification(after, torque)
        if self._switched:
            self._switched = False
            self._since = tick if self._is_driving else None
            self._difference[:] = self._last - torque
        if self._since is not None:
            torque = self._blend_torque(torque, tick - self._since)
        np.minimum(np.maximum(torque, -self._torque), self._torque, out=self._last)  # keeps NaN
        self._is_driving = True
        return self._last

    def _apply_modification(self, state: ModificationState, changed: Array) -> bool:
        """Apply one modification, and switch it off if it fails. Return True if it succeeded."""
        failure = state.apply_to(self._sample, changed)
        if failure:
            state.is_on = False
            self._failed[state.name] = failure
            self._findings.append(Finding(Alarm.MODIFICATION, state.number))
            self._update_hooks()
        return not failure

    def _blend_torque(self, torque: Array, ticks: int) -> Array:
        """Add the torque step of the last switch, faded out over the time since the switch.

        Args:
            torque: Torques of the law after the switch, (joints,), N m.
            ticks: Ticks since the switch.

        Returns:
            Torques, (joints,), N m.
        """
        passed = ticks / self._ticks  # fraction of the transfer time that has passed
        if passed >= 1.0:
            self._since = None
            return torque
        return torque + (1.0 - passed) ** 2 * (1.0 + 2.0 * passed) * self._difference

    def _update_hooks(self) -> None:
        """Group the active modifications by hook, and list them and the failed ones in `reason`."""
        active = [state for state in self._all.values() if state.is_on]
        self._before, self._instead, self._after = (
            [state for state in active if state.modification.hook == hook] for hook in Hook
        )
        self._switched = True
        parts = [f"modification '{name}' taken out: {why}" for name, why in self._failed.items()]
        if active:
            parts.append(f"modified by {', '.join(state.name for state in active)}")
        self.reason = "; ".join(parts)
