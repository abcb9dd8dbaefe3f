"""Times from a trace: plan ages, and the occupation of a core."""

from __future__ import annotations

import numpy as np

from rack.levels.timing.trace_times import Occupation, plan_ages


def test_a_plan_ages_until_the_next_one_can_be_read() -> None:
    executor, made, visible_at = np.arange(20), np.array([0, 8]), np.array([4, 12])
    # Plan 0 is read in ticks 4 to 11, plan 8 in 12 to 19.
    assert plan_ages(executor, made, visible_at).tolist() == [*range(4, 12), *range(4, 12)]


def test_a_late_plan_is_not_visible_before_its_own_tick() -> None:
    made, visible_at = np.array([0, 4, 8]), np.array([4, 15, 12])
    assert plan_ages(np.array([3, 11, 12, 14, 15]), made, visible_at).tolist() == [11, 12, 14, 7]


def test_occupied_time_within_a_stretch_equals_a_count_of_moments() -> None:
    random = np.random.default_rng(3)
    for _ in range(200):
        starts = random.integers(0, 60, random.integers(0, 12))
        ends = starts + random.integers(0, 12, len(starts))
        occupied = {t for start, end in zip(starts, ends, strict=True) for t in range(start, end)}
        asked = np.sort(random.integers(-5, 80, (9, 2)), axis=1)
        found = Occupation(starts, ends).within(asked[:, 0], asked[:, 1])
        assert found.tolist() == [len(occupied & set(range(start, end))) for start, end in asked]
