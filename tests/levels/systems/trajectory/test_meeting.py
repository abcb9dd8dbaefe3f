"""The agreed start of two arms, whatever the other rack says of its arrival."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest

from rack.levels.systems.trajectory.meeting import MeetingWork

ARRIVED_S, MEETING_S = 4.0, 0.1
LARGEST = 2**32 - 1


@pytest.mark.parametrize(
    ("number", "arrived_s", "start_s"),
    [
        (1, 3.0, 4.1),
        (1, 5.0, 5.1),
        # It has not arrived at this meeting yet.
        (0, 9.0, math.inf),
        # It has met again since, so that the time of its arrival here is not known.
        (2, 9.0, 4.1),
        (LARGEST, 1e308, 4.1),
        # Values that no rack sends: this arm never begins before it has arrived, or waits.
        (1, -1e308, 4.1),
        (1, math.nan, 4.1),
        (1, 1e308, 1e308),
        (1, math.inf, math.inf),
    ],
)
def test_arms_begin_after_the_later_arrival(number: int, arrived_s: float, start_s: float) -> None:
    work = SimpleNamespace(
        meeting=SimpleNamespace(number=1, arrived=ARRIVED_S),
        partner_number=number,
        partner_arrived_s=arrived_s,
        _meeting_s=MEETING_S,
    )
    start = MeetingWork.start_s.fget
    assert start is not None
    assert start(work) == pytest.approx(start_s)
