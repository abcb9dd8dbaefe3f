"""The motors' monitor alone: what it makes of torques that neither the motion nor dry friction took."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rack.levels.level import Finding
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.limits import PRESSING
from rack.levels.servo.actuator_monitor import SURE_CYCLES, ActuatorMonitor
from tests.levels.arms import cell
from tests.levels.servo_rig import TICK_S

Array = NDArray[np.float64]

CELL = cell("puma560")
REST = np.zeros(6)
HELD_BY_FRICTION = math.tanh(2.0) * CELL.model.dof_frictionloss[CELL.dof]
"""Torques that dry friction takes at rest, N m."""


class Bench:
    """An arm that rests in its home, with torques left over as a test says."""

    def __init__(self) -> None:
        self.monitor = ActuatorMonitor(CELL, following=0.02, period_s=TICK_S)
        self.terms = Dynamics(CELL).terms(CELL.home, REST)

    def leave(self, cycles: int, holds: bool = False, **left: float) -> list[Finding]:
        """Leave these torques over, N m, by joint from `j1` on, for some cycles; return what is found."""
        over = REST.copy()
        for joint, torque in left.items():
            over[int(joint[1:]) - 1] = torque
        found = []
        for _ in range(cycles):
            taken = np.where(over, np.copysign(HELD_BY_FRICTION, over), 0.0)
            self.monitor.begin(REST, self.terms, self.terms.bias + over + taken)
            found.append(self.monitor.look(REST, self.terms, REST, holds))
        return [finding for finding in found if finding is not None]


def test_a_part_that_is_pressed_on_its_support_is_no_motor_at_fault() -> None:
    bench = Bench()
    assert bench.leave(10, j2=-20.0, j3=-3.9, j5=1.1) == []
    # The arm has turned to it: only the wrist still presses, and is told a little more in every cycle.
    for cycle in range(40):
        assert bench.leave(1, j5=1.6 + 0.01 * cycle) == []


def test_a_motor_that_lacks_more_than_a_contact_takes_is_found_while_a_part_presses() -> None:
    bench = Bench()
    bench.leave(10, j2=-2.5, j3=-1.4, j5=2.2)
    much = (PRESSING + 0.01) * CELL.bounds.torque[1]
    found = bench.leave(SURE_CYCLES, j2=much, j3=-9.8, j5=0.4)
    assert [finding.subject for finding in found] == [1]


def test_a_wrist_that_lacks_torque_is_found_again_once_nothing_presses() -> None:
    bench = Bench()
    bench.leave(10, j2=-20.0, j3=-3.9, j5=1.1)
    bench.leave(1)
    found = [bench.leave(1, j5=2.0 + cycle) for cycle in range(SURE_CYCLES)]
    assert [finding.subject for finding in found[-1]] == [4]


def test_a_part_that_presses_a_little_more_in_every_cycle_is_no_motor_at_fault() -> None:
    # Dry friction hides the push at all joints but one.
    bench = Bench()
    for cycle in range(100):
        assert bench.leave(1, holds=True, j5=0.41 + 0.03 * min(cycle, 30)) == []
