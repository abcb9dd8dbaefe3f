"""Time laws and ramps to rest are smooth and keep the limits of every joint."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rack.levels.systems.trajectory.legs import RampToRest, TimeLaw
from tests.levels.arms import cell

CELL = cell("puma560")
H = 1e-3
parts = st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6)


def test_a_leg_is_smooth_and_passes_its_goal_in_the_middle_of_its_blend() -> None:
    law = TimeLaw(segment_s=1.0, half_blend_s=0.2)
    t = np.arange(0.0, law.ends_s + H, H)
    s = np.array([law.compute_progress(time) for time in t])
    speed = np.diff(s) / H
    assert s[0] == 0.0
    assert law.compute_progress(law.ends_s) == 1.0
    assert law.compute_progress(99.0) == 1.0
    assert (speed >= 0.0).all()
    assert abs(speed.max() - 1.0) < 1e-9
    assert np.abs(np.diff(speed)).max() / H <= 0.75 / 0.2 + 1e-6
    # At full speed the leg would reach its goal at the nominal time.
    at = law.ends_s / 2.0
    assert abs(law.compute_progress(at) + (law.nominal_s - at) / law.segment_s - 1.0) < 1e-12


@pytest.mark.slow
@given(parts, parts, st.floats(0.1, 1.0))
@settings(max_examples=25)
def test_a_ramp_to_rest_keeps_the_limits(v: list[float], a: list[float], least: float) -> None:
    limits = CELL.limits
    velocity, acceleration = np.array(v) * limits.velocity, np.array(a) * limits.acceleration
    ramp = RampToRest((CELL.home, velocity, acceleration), limits.acceleration, least)
    assert np.array_equal(ramp.compute_position(0.0), CELL.home)
    assert np.array_equal(ramp.compute_position(ramp.ends_s + 1.0), ramp.end)
    speed = (ramp.compute_position(1e-6) - ramp.compute_position(0.0)) / 1e-6
    assert np.allclose(speed, velocity, atol=1e-4)
    t = np.linspace(0.0, ramp.ends_s, 400)
    bend = np.diff([ramp.compute_position(time) for time in t], 2, axis=0) / t[1] ** 2
    assert (np.abs(bend) <= limits.acceleration * (1 + 1e-6) + 1e-5).all()
