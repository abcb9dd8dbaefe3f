"""A guarded line: a lasting change of a torque ends it; one across brakes, holds or missed cycles
does not."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rack.levels.systems.trajectory.messages import MotionKind, RequestEnd
from tests.levels.systems.trajectory.rig import EVERY, TrajectoryRig

DOWN = (0.0, 0.0, 1.0, 0.0)
MOST, TOUCH = 6.0, 20.0
"""A guard, and a change of torque by a touch, N m."""


@pytest.fixture
def rig() -> TrajectoryRig:
    """A level on its way down, at speed."""
    rig = TrajectoryRig()
    x, y, z = rig.run(0.2).tool
    rig.request(MotionKind.POSE, position=(x, y, z - 0.1), quaternion=DOWN, segment=4.0, touch=MOST)
    rig.run(1.0)
    assert rig.written["status"].current == 1
    return rig


def press(rig: TrajectoryRig, torque: float) -> None:
    """Let a joint of the first board need more torque, N m."""
    next(iter(rig.statuses.values())).torque[2] += torque


def end(rig: TrajectoryRig, seconds: float = 0.6) -> int:
    """Run for a while; return how the guarded line has ended."""
    rig.run(seconds)
    return rig.ends().get(1, RequestEnd.NONE)


@pytest.mark.parametrize("torque", [TOUCH, -TOUCH])
def test_a_touch_ends_the_line_and_the_next_request_goes_on_from_there(
    rig: TrajectoryRig, torque: float
) -> None:
    height = float(rig.written["status"].tool[2])
    press(rig, torque)
    assert end(rig) == RequestEnd.GUARDED
    assert rig.written["status"].resting
    assert height - rig.written["status"].tool[2] < 0.01
    rig.joints([0.1, 0, 0, 0, 0, 0])
    rig.run(4.0)
    assert rig.ends()[2] == RequestEnd.DONE
    assert max(rig.excess()) <= 1.0


def at_once(rig: TrajectoryRig) -> float:
    press(rig, TOUCH)
    rig.cycle()
    return -TOUCH


def across_a_hold(rig: TrajectoryRig) -> float:
    rig.brake()
    rig.read()
    rig.level.process(rig.tick)
    rig.tick += EVERY
    return TOUCH


def across_missed_cycles(rig: TrajectoryRig) -> float:
    rig.tick += 2 * EVERY
    return TOUCH


def across_a_stale_status(rig: TrajectoryRig) -> float:
    rig.lost = {next(iter(rig.statuses))}
    rig.cycle()
    rig.lost = set()
    return TOUCH


@pytest.mark.parametrize(
    "before",
    [lambda rig: 0.9 * MOST, at_once, across_a_hold, across_missed_cycles, across_a_stale_status],
)
def test_a_change_that_is_no_touch(
    rig: TrajectoryRig, before: Callable[[TrajectoryRig], float]
) -> None:
    press(rig, before(rig))
    assert end(rig) == RequestEnd.NONE


def test_the_guard_outlives_the_level(rig: TrajectoryRig) -> None:
    rig.restart()
    rig.run(1.5)
    rig.brake()
    rig.tick += 2 * EVERY
    rig.run(1.5)
    assert rig.written["status"].current == 1
    press(rig, TOUCH)
    assert end(rig) == RequestEnd.GUARDED


@pytest.mark.parametrize("most", [-1.0, float("nan")])
def test_a_guard_that_is_none_is_refused(most: float) -> None:
    rig = TrajectoryRig()
    place = rig.run(0.2).tool
    rig.request(MotionKind.POSE, position=place, quaternion=DOWN, touch=most)
    assert end(rig) == RequestEnd.REFUSED
    assert "guard" in rig.written["status"].reason
