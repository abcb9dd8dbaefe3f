"""A servo law with control modifications: switched without a step, undone when they fail."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from rack.backplane.watch.alarms import Alarm
from rack.levels.algebra import Array
from rack.levels.errors import LevelError
from rack.levels.level import Finding
from rack.levels.servo.common_modifications import DeadZone, JointPd, Notch
from rack.levels.servo.curves import Motion
from rack.levels.servo.modification import (
    Hook,
    LawContext,
    LawSample,
    ModifiableParams,
    Modification,
)
from rack.levels.servo.modified_law import ModifiedLaw
from tests.levels.arms import cell, config, context

TICK_NS = 1_000_000
TRANSFER_TICKS = 50
JOINTS = 6
LIMITS = cell("puma560").bounds.torque
STATE, INERTIA, LOAD = np.zeros((2, JOINTS)), np.full(JOINTS, 2.0), np.full(JOINTS, 7.0)
HERE = f"{__name__}:"
COMMON = "rack.levels.servo.common_modifications:"


class Half(Modification):
    """Halves the torque."""

    hook = Hook.AFTER

    def modify(self, sample: LawSample) -> None:
        sample.torque = 0.5 * sample.torque


class Further(Modification):
    """Moves the wanted positions by one rad."""

    hook = Hook.BEFORE

    def modify(self, sample: LawSample) -> None:
        sample.wanted_position += 1.0


class Nine(Modification):
    """Sets 9 N m in place of the law."""

    hook = Hook.INSTEAD

    def modify(self, sample: LawSample) -> None:
        assert np.isnan(sample.torque).all()
        sample.torque[:] = 9.0


class Counts(Modification):
    """Adds the number of its samples since it was switched on, N m."""

    hook = Hook.AFTER

    def begin(self, sample: LawSample) -> None:
        self.samples = 0

    def modify(self, sample: LawSample) -> None:
        self.samples += 1
        sample.torque += self.samples


class Huge(Modification):
    hook = Hook.AFTER

    def modify(self, sample: LawSample) -> None:
        sample.torque += 1e6


class Raises(Modification):
    """Spoils the torque, then fails in its third sample."""

    hook = Hook.AFTER

    def begin(self, sample: LawSample) -> None:
        self.left = 3

    def modify(self, sample: LawSample) -> None:
        self.left -= 1
        sample.torque += 2.0
        if not self.left:
            raise ZeroDivisionError("left nothing")


class GivesNan(Modification):
    hook = Hook.BEFORE

    def modify(self, sample: LawSample) -> None:
        sample.velocity[2] = np.nan


class SetsNothing(Modification):
    hook = Hook.INSTEAD

    def modify(self, sample: LawSample) -> None:
        pass


class Bench:
    """A modified law with torque = 3 N m + 10 N m/rad times the wanted position."""

    def __init__(self, **modifications: Mapping[str, Any] | str) -> None:
        named = {n: {"class": HERE + m} for n, m in modifications.items() if isinstance(m, str)}
        level = context("servo", config("puma560"), clock_ns=TICK_NS, seed=0)
        self.findings: list[Finding] = []
        params = ModifiableParams(
            modifications=modifications | named, transfer=TRANSFER_TICKS * TICK_NS * 1e-9
        )
        self.law = ModifiedLaw(level, params, LIMITS, self.findings)
        self.tick = 0

    def switch(self, name: str, is_on: bool) -> str:
        return self.law.switch_modification(name, is_on)

    def run(self, samples: int) -> Array:
        """Return the torque of the third joint in each sample, N m."""
        found = []
        for _ in range(samples):
            given = Motion(np.zeros((3, JOINTS))), STATE, INERTIA, LOAD, self.tick
            found.append(self.law.compute_torque(self._law, *given)[2])
            self.tick += 1
        return np.array(found)

    @staticmethod
    def _law(motion: Motion, state: Array) -> Array:
        return 3.0 + 10.0 * motion.position + 0.0 * state[1]


@pytest.mark.parametrize(("name", "after"), [("Half", 1.5), ("Further", 13.0), ("Nine", 9.0)])
def test_after_a_switch_the_torque_changes_smoothly(name: str, after: float) -> None:
    bench = Bench(it=name)
    bench.run(5)
    assert bench.switch("it", True) == ""
    torque = bench.run(TRANSFER_TICKS + 3)
    assert torque[0] == pytest.approx(3.0, abs=1e-12)
    assert torque[TRANSFER_TICKS // 2] == pytest.approx(0.5 * (3.0 + after))
    assert torque[TRANSFER_TICKS - 1] != after
    assert torque[TRANSFER_TICKS:].tolist() == [after] * 3
    bench.switch("it", False)
    back = bench.run(TRANSFER_TICKS + 1)
    assert back[0] == pytest.approx(after, abs=1e-12)
    assert back[-1] == 3.0


def test_modifications_act_at_their_hooks_in_the_order_of_the_config() -> None:
    kinds = {"half": "Half", "counts": "Counts", "further": "Further"}
    tables = {name: {"class": HERE + kind, "on": True} for name, kind in kinds.items()}
    assert Bench(**tables).run(2).tolist() == [0.5 * 13.0 + 1.0, 0.5 * 13.0 + 2.0]


def test_a_modification_in_place_of_the_law_replaces_another() -> None:
    bench = Bench(nine="Nine", pd={"class": COMMON + "JointPd"}, huge="Huge")
    bench.switch("nine", True)
    bench.run(60)
    bench.switch("pd", True)
    assert bench.law.reason == "modified by pd"
    assert bench.run(60)[-1] == LOAD[2]
    assert bench.switch("third", True) == "no modification 'third'; permitted: nine, pd, huge"
    # The limits stay in force.
    bench.switch("huge", True)
    assert np.max(bench.run(100)) == LIMITS[2]
    tables = {name: {"class": HERE + "Nine", "on": True} for name in ("one", "two")}
    with pytest.raises(ValueError, match="only one may be on in place of the law, not one, two"):
        ModifiableParams.model_validate({"modifications": tables})


def test_a_modification_that_raises_is_undone_and_switched_off_in_the_same_sample() -> None:
    bench = Bench(raises="Raises", half={"class": HERE + "Half", "on": True})
    bench.run(1)
    bench.switch("raises", True)
    torque = bench.run(TRANSFER_TICKS + 5)
    assert torque[-1] == 1.5
    # The failure itself is a switch: no step.
    assert np.abs(np.diff(torque)).max() < 0.1
    assert bench.findings == [Finding(Alarm.MODIFICATION, 0)]
    why = "modification 'raises' taken out: ZeroDivisionError: left nothing; modified by half"
    assert bench.law.reason == why
    bench.switch("raises", False)
    assert bench.law.reason == "modified by half"


@pytest.mark.parametrize("name", ["GivesNan", "SetsNothing"])
def test_a_modification_with_a_result_that_is_not_finite_is_switched_off(name: str) -> None:
    bench = Bench(it=name)
    bench.run(1)
    bench.switch("it", True)
    assert bench.run(3).tolist() == [3.0] * 3
    assert bench.law.reason == "modification 'it' taken out: its result is not finite"
    # Put in again, it fails again.
    bench.switch("it", True)
    bench.run(1)
    assert len(bench.findings) == 2


def law_of(**params: Any) -> LawContext:
    return LawContext([f"j{k}" for k in range(JOINTS)], 0.001, LIMITS, params)


def sample_of(**vectors: float) -> LawSample:
    sample = LawSample(JOINTS)
    for name, value in vectors.items():
        setattr(sample, name, value)
    return sample


@pytest.mark.parametrize(
    ("error", "seen"), [(0.0005, 0.0), (-0.0005, 0.0), (0.003, 0.002), (-0.003, -0.002)]
)
def test_a_dead_zone_hides_small_errors_and_reduces_larger_ones(error: float, seen: float) -> None:
    sample = sample_of(position=1.0, wanted_position=1.0 + error)
    DeadZone(law_of(width=0.001)).modify(sample)
    assert sample.wanted_position - sample.position == pytest.approx(seen, abs=1e-15)


def test_pd_controls_each_joint_separately_with_or_without_load() -> None:
    wanted = {"wanted_position": 0.1, "wanted_velocity": 0.2}
    sample = sample_of(**wanted, inertia=2.0, load=7.0, torque=np.nan)
    JointPd(law_of(bandwidth=10.0, damping=0.5)).modify(sample)
    assert sample.torque == pytest.approx(2.0 * (100.0 * 0.1 + 10.0 * 0.2) + 7.0)
    JointPd(law_of(bandwidth=10.0, damping=0.5, load=False)).modify(sample)
    assert sample.torque == pytest.approx(24.0)


@pytest.mark.parametrize(
    ("frequency", "least", "most"), [(60.0, 0.0, 0.02), (3.0, 0.99, 1.01), (200.0, 0.9, 1.01)]
)
def test_a_notch_removes_only_its_frequency(frequency: float, least: float, most: float) -> None:
    notch, sample, passed = Notch(law_of(frequency=60.0)), sample_of(torque=5.0), []
    why = "frequency = 500 Hz: must be below half the law's rate, 500 Hz"
    with pytest.raises(LevelError, match=why):
        Notch(law_of(frequency=500.0))
    # It begins without a transient.
    notch.begin(sample)
    notch.modify(sample)
    assert sample.torque == pytest.approx(5.0)
    for tick in range(1000):
        sample.torque = 5.0 + np.sin(2.0 * np.pi * frequency * 0.001 * tick)
        notch.modify(sample)
        passed.append(sample.torque[0])
    assert least <= np.abs(np.array(passed[500:]) - 5.0).max() <= most


HALF, ZONE = {"class": HERE + "Half"}, {"class": COMMON + "DeadZone"}
HOOKS = "must be one of before, instead, after"
MISTAKES = {
    "no class": ({"class": COMMON + "Notsch"}, "has no class 'Notsch'"),
    "another class": (
        {"class": "rack.levels.servo:ServoExecutor"},
        "has no Modification named 'ServoExecutor'",
    ),
    "half a class": ({"class": HERE + "Unfinished"}, "'Unfinished' does not implement: modify"),
    "no hook": ({"class": HERE + "Hookless"}, f"'Hookless' has the hook None; {HOOKS}"),
    "unknown hook": ({"class": HERE + "Later"}, f"'Later' has the hook 'later'; {HOOKS}"),
    "params of one without": (
        {**HALF, "params": {"gain": 2.0}},
        "'Half' takes no params; remove them",
    ),
    "params": ({**ZONE, "params": {"width": -1.0}}, "params.width = -1.0: input should be"),
    "unknown key": ({**HALF, "onn": True}, "Extra inputs"),
}


class Unfinished(Modification):
    hook = Hook.AFTER


class Hookless(Modification):
    def modify(self, sample: LawSample) -> None:
        pass


class Later(Hookless):
    hook = "later"  # type: ignore[assignment]


@pytest.mark.parametrize(("table", "expected"), MISTAKES.values(), ids=MISTAKES)
def test_a_table_is_checked_with_its_class(table: Mapping[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=re.escape(expected)):
        ModifiableParams.model_validate({"modifications": {"it": table}})
