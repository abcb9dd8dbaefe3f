"""The context switch: the gap in a planner's time minus the executor's time in it."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.segment import SHM_FOLDER
from rack.tools.console.answer import Failure
from rack.tools.lab.reproduction.experiments.switch import compute_switch_times_us, measure_switch
from tests.machine import needs_fifo, needs_two_cores


def test_a_gap_minus_the_executors_time_is_two_switches() -> None:
    gaps = np.array([[1_000, 51_000], [101_000, 171_000]])
    awake = np.array([[11_000, 31_000], [121_000, 131_000]])
    times = compute_switch_times_us(gaps, awake)
    assert (times["min"], times["max"]) == (15.0, 30.0)


def test_a_wake_up_outside_the_planners_time_does_not_count_as_a_switch() -> None:
    gaps = np.array([[1_000, 51_000], [0, 0], [101_000, 111_000]])
    awake = np.array([[11_000, 31_000], [61_000, 62_000], [105_000, 112_000]])
    times = compute_switch_times_us(gaps, awake)
    assert times["min"] == times["max"] == 15.0
    with pytest.raises(Failure, match="too busy"):
        compute_switch_times_us(gaps[1:], awake[1:])


@pytest.mark.thorough
@needs_fifo
@needs_two_cores
def test_a_switch_is_measured_with_real_processes_and_nothing_is_left() -> None:
    before = set(SHM_FOLDER.iterdir())
    times = measure_switch()
    assert 0 < times["min"] <= times["p50"] <= times["max"]
    assert not [path for path in set(SHM_FOLDER.iterdir()) - before if "sem" in path.name]
