"""Engagements of the brakes in a run are counted with their reasons; long ones make it fail."""

from __future__ import annotations

import pytest

from rack.boards import Rack
from rack.boards.events import NO_TORQUE
from tests.boards.arm_racks import TOGETHER, arm_rack
from tests.boards.conftest import MakeConfig

pytestmark = pytest.mark.thorough

RELEASED = "rack.levels.systems.joint_boards:ArmExecutor"


def stalling(**params: int) -> str:
    """Return a rack of 1 kHz whose arm's board stalls, as TOML."""
    given = ", ".join(f"{key} = {value}" for key, value in params.items())
    return arm_rack(TOGETHER).replace(
        f'"{RELEASED}"', f'"joint_levels:StallingArm"\nparams = {{ {given} }}'
    )


@pytest.mark.slow
@pytest.mark.parametrize(("stall", "count"), [(4, 0), (5, 2)])
def test_a_stall_longer_than_the_patience_is_one_braking_with_its_time(
    config: MakeConfig, stall: int, count: int
) -> None:
    with Rack(config(text=stalling(stall=stall))) as rack:
        outcome = rack.run(1.1)
    assert (outcome.faults, outcome.is_success) == ((), True)
    assert [braking.why for braking in outcome.brakings] == [NO_TORQUE] * count
    for number, braking in enumerate(outcome.brakings, 1):
        # The last torque was given in the last cycle before the stall, and the motors kept it for 5
        # cycles.
        assert braking.since == 400 * number - stall - 1 + 5
        # The boards above must see that the arm was braked before it is released.
        assert stall - 4 < braking.lasted_ms < stall - 4 + 6


HELD = "held without a known cause"


@pytest.mark.slow
def test_a_run_held_by_brakes_has_failed_and_says_so(config: MakeConfig) -> None:
    with Rack(config(text=stalling(stall=400, period=600))) as rack:
        outcome = rack.run(0.65)
    assert (outcome.cause, outcome.is_success) == ("time over", False)
    (fault,) = outcome.faults
    assert fault.startswith(f"{HELD}, in 650 ms: brakes engaged 1 time, ")
    assert fault.endswith(" ms at tick 204: no torque (1)")
