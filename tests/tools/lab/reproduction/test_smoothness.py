"""Smooth motion: sweeps of jitter, overruns and rate, and an arm that jitter does not reach."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rack.tools.lab.reproduction.experiments import smoothness
from rack.tools.lab.reproduction.rules import judge_smoothness
from rack.tools.lab.reproduction.verdict import Ruling, describe_unmet
from tests.tools.lab.reproduction.breaking import BreakingWorkshop

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(300)]

PUNCTUAL = f"""python_path = ["{Path(__file__).parent}"]
[board.servo.params]
arm = "late_arm:PunctualArm"
"""


def test_motion_becomes_rougher_unless_jitter_does_not_reach_the_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(smoothness, "SECONDS", 6.0)
    monkeypatch.setattr(smoothness, "JITTER_TICKS", (0.1, 0.4))
    monkeypatch.setattr(smoothness, "OVERRUN_CYCLES", (0.95, 4.0, 6.0))
    monkeypatch.setattr(smoothness, "RATES_HZ", (100, 50))
    workshop = BreakingWorkshop(tmp_path, {}, 6.0)
    found = smoothness.SMOOTHNESS.measure_if_possible(workshop)
    verdict = judge_smoothness(found)
    assert describe_unmet(verdict.checks) == ""
    assert verdict.ruling is Ruling.HOLDS
    # The deviation of two uniform numbers.
    assert found.jitter[1].deviation_ms == pytest.approx(0.4 * 2.5 / 6**0.5, rel=0.1)
    assert found.overrun[0] == replace(found.undisturbed, value=0.95)
    assert [line.split()[0] for line in found.chart.splitlines()] == [
        "sweep",
        "undisturbed",
        *["jitter"] * 2,
        *["overrun"] * 3,
        *["rate"] * 2,
    ]
    punctual = smoothness.measure_jitter(BreakingWorkshop(tmp_path, {"nasrem": PUNCTUAL}, 6.0))
    broken = judge_smoothness(replace(found, jitter=punctual))
    assert broken.ruling is Ruling.FAILS
    assert "jitter_error_mrad" in describe_unmet(broken.checks)
    assert "brakings_at_largest_jitter 0, not >= 1" in describe_unmet(broken.checks)
