"""A guarded line ends by a lasting change of torque, but not across brakes or missed cycles."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rack.levels.systems.trajectory.messages import MotionKind, RequestEnd
from tests.levels.systems.trajectory.rig import EVERY, TrajectoryRig

DOWN = (0.0, 0.0, 1.0, 0.0)
# Threshold of the guard, and change of torque by a touch, N m.
MOST, TOUCH = 6.0, 20.0


@pytest.fixture
def rig() -> TrajectoryRig:
    """Return a level that moves the tool downward at full speed."""
    rig = TrajectoryRig()
    x, y, z = rig.run(0.2).tool
    rig.request(MotionKind.POSE, position=(x, y, z - 0.1), quaternion=DOWN, segment=4.0, touch=MOST)
    rig.run(1.0)
    assert rig.written["status"].current == 1
    return rig


def press(rig: TrajectoryRig, torque: float) -> None:
    """Increase the torque of a joint of the first board, N m."""
    next(iter(rig.statuses.values())).torque[2] += torque


def run_to_end(rig: TrajectoryRig) -> int:
    """Run for some time, and return how the guarded line has ended."""
    rig.run(0.6)
    return rig.ends().get(1, RequestEnd.NONE)


@pytest.mark.parametrize("torque", [TOUCH, -TOUCH])
def test_a_touch_ends_the_line_where_it_is(rig: TrajectoryRig, torque: float) -> None:
    height = float(rig.written["status"].tool[2])
    press(rig, torque)
    assert run_to_end(rig) == RequestEnd.GUARDED
    assert rig.written["status"].resting
    assert height - rig.written["status"].tool[2] < 0.01
    rig.joints([0.1, 0, 0, 0, 0, 0])
    rig.run(4.0)
    assert rig.ends()[2] == RequestEnd.DONE
    assert max(rig.excess()) <= 1.0


def in_one_cycle(rig: TrajectoryRig) -> float:
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


INTERRUPTIONS = (in_one_cycle, across_a_hold, across_missed_cycles, across_a_stale_status)


@pytest.mark.parametrize("before", [lambda rig: 0.9 * MOST, *INTERRUPTIONS])
def test_a_small_or_interrupted_change_of_torque_is_not_a_touch(
    rig: TrajectoryRig, before: Callable[[TrajectoryRig], float]
) -> None:
    press(rig, before(rig))
    assert run_to_end(rig) == RequestEnd.NONE


def test_a_guard_remains_active_after_a_restart(rig: TrajectoryRig) -> None:
    rig.restart()
    rig.run(1.5)
    rig.brake()
    rig.tick += 2 * EVERY
    rig.run(1.5)
    assert rig.written["status"].current == 1
    press(rig, TOUCH)
    assert run_to_end(rig) == RequestEnd.GUARDED


@pytest.mark.parametrize("most", [-1.0, float("nan")])
def test_an_invalid_guard_is_refused(most: float) -> None:
    rig = TrajectoryRig()
    place = rig.run(0.2).tool
    rig.request(MotionKind.POSE, position=place, quaternion=DOWN, touch=most)
    assert run_to_end(rig) == RequestEnd.REFUSED
    assert "guard" in rig.written["status"].reason
