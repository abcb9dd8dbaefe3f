"""A servo law with control modifications, which are switched between two samples without a step in
the torque.

In the first sample after a switch the torque is that of the sample before it. Its difference from
the torque of the law as now modified decays to zero, with zero slope at both ends, while the new
law is already in force. So a switch adds nothing to the torque but this difference, whatever the
modifications compute; limits apply to the sum. Alternatives considered: to evaluate old and new law
in one sample (a modification with state would act twice), and a ramp of gains (it must know what is
inside the law).

A modification that raises an exception, or whose result is not finite, is undone and taken out in
the same sample: the law goes on without it, and the torque goes over to it in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

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


class LawInputs(NamedTuple):
    """What a law is given in one sample. Vectors are (joints,); see `LawSample`."""

    motion: Motion  # wanted
    state: Array  # (2, joints): rad, rad/s
    inertia: Array  # kg m2
    load: Array  # N m
    tick: int


@dataclass
class Modified:
    """One modification of a law, put in or not."""

    number: int
    name: str
    modification: Modification
    is_on: bool
    begins: bool = True  # the next sample is its first

    def act(self, sample: LawSample, changed: Array) -> str:
        """Modify a sample, of which it changes one array; return why that failed, empty: it did
        not.
        """
        kept = changed.copy()
        why = ""
        try:
            if self.begins:
                self.begins = False
                self.modification.begin(sample)
            self.modification.modify(sample)
        except Exception as error:  # a user's code may raise anything
            why = f"{type(error).__name__}: {error}"
        else:
            if not np.isfinite(changed).all():
                why = "its result is not finite"
        if why:
            changed[:] = kept
        return why


class ModifiedLaw:
    """Modifies one law. `reason` says which modifications are in, and which have failed."""

    def __init__(
        self,
        context: LevelContext,
        params: ModifiableParams,
        torque: Array,
        findings: list[Finding],
    ) -> None:
        """Limit torques to `torque`, (joints,), N m; report failures as `findings`."""
        joints = context.robot.joints
        period_s = context.period_s
        self.exists = bool(params.modifications)  # without one, `torque` is the law's
        self._all = {
            name: Modified(
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
        self._difference = np.zeros(len(joints))  # N m: from the law's torque to it, at the switch
        self._since: int | None = None  # tick of the switch; None: the difference has decayed
        self._is_driving = False  # the last sample's torque was given to the arm
        self._switched = False  # after the last sample
        self._failed: dict[str, str] = {}  # why, by name, for those taken out
        self._arrange()

    def switch(self, name: str, is_on: bool) -> str:
        """Put a modification in, or take it out, with the next sample; return why that is refused,
        empty: it is not.
        """
        one = self._all.get(name)
        if one is None:
            return f"no modification '{name}'; permitted: {', '.join(self._all) or 'none'}"
        if is_on != one.is_on or one.name in self._failed:
            self._failed.pop(one.name, None)
            if is_on and one.modification.hook == Hook.INSTEAD:
                for other in self._hooked(Hook.INSTEAD):
                    other.is_on = False
            one.is_on = one.begins = is_on
            self._arrange()
        return ""

    def interrupt(self) -> None:
        """Forget the last torque: the arm was braked."""
        self._is_driving = False

    def torque(self, law: Law, given: LawInputs) -> Array:
        """Return the torques, (joints,), N m, of `law` as modified. Valid until the next call."""
        torque = self._modified(law, given) if self._in else law(given.motion, given.state)
        tick = given.tick
        if self._switched:
            self._switched = False
            self._since = tick if self._is_driving else None
            self._difference[:] = self._last - torque
        if self._since is not None:
            torque = self._go_over(torque, tick - self._since)
        np.minimum(np.maximum(torque, -self._torque), self._torque, out=self._last)  # NaN stays
        self._is_driving = True
        return self._last

    def _modified(self, law: Law, given: LawInputs) -> Array:
        sample = self._sample
        sample.tick = given.tick
        sample.inertia = given.inertia
        sample.load = given.load
        sample.seen[:3] = given.motion.table
        sample.seen[3:] = given.state
        sample.torque[:] = np.nan
        for one in self._before:
            self._act(one, sample.seen)
        if not any(self._act(one, sample.torque) for one in self._instead):
            sample.torque = law(sample.motion, sample.seen[3:])
        for one in self._after:
            self._act(one, sample.torque)
        return sample.torque

    def _act(self, one: Modified, changed: Array) -> bool:
        why = one.act(self._sample, changed)
        if why:
            one.is_on = False
            self._failed[one.name] = why
            self._findings.append(Finding(Alarm.MODIFICATION, one.number))
            self._arrange()
        return not why

    def _go_over(self, torque: Array, ticks: int) -> Array:
        """Return the torque with what is left of the difference, `ticks` after the switch."""
        passed = ticks / self._ticks
        if passed >= 1.0:
            self._since = None
            return torque
        return torque + (1.0 - passed) ** 2 * (1.0 + 2.0 * passed) * self._difference

    def _hooked(self, hook: Hook) -> Sequence[Modified]:
        return [one for one in self._in if one.modification.hook == hook]

    def _arrange(self) -> None:
        """Take over a switch."""
        self._in = [one for one in self._all.values() if one.is_on]
        self._before, self._instead, self._after = (self._hooked(hook) for hook in Hook)
        self._switched = True
        failed = [f"modification '{name}' taken out: {why}" for name, why in self._failed.items()]
        into = [f"modified by {', '.join(one.name for one in self._in)}"] if self._in else []
        self.reason = "; ".join(failed + into)
