"""A coordinator and the PUMA in one rack: orders carried out, kept to their times, through losses
and restarts."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.messages import Error
from rack.levels.operator import Operation
from tests.levels.lockstep import Lockstep, Operator
from tests.levels.systems.cell.rack import CellRack

pytestmark = pytest.mark.thorough

PLACE = [0.50, -0.20, 0.475]
TRANSFER = {"do": "transfer", "object": "block1", "to": PLACE}
REACH = {"do": "goto", "position": [0.45, 0.10, 0.95]}
SLOWLY = {**REACH, "by": 14.0}
HOME = {"do": "home"}


def is_over(rack: Lockstep) -> bool:
    """Say whether both levels have ended."""
    return all(
        rack.read(box).state in (State.DONE, State.ERROR) for box in ("cell.status", "task.status")
    )


def is_moving(rack: Lockstep) -> bool:
    """Say whether the first move of an order is under way."""
    return bool(rack.read("elemental_move.status").progress > 0.1)


def test_object_is_transferred_by_order_and_both_runs_end() -> None:
    rack = CellRack([TRANSFER])
    assert rack.run(30.0, is_over)
    assert (rack.cell.state, rack.task.state) == (State.DONE, State.DONE)
    assert rack.read("world.model").position[0] == pytest.approx(PLACE, abs=2e-3)
    assert (rack.cell.action, rack.cell.moves_done, rack.task.action) == (1, 8, 1)


def test_promised_time_is_kept_though_one_board_after_another_is_killed() -> None:
    rack = CellRack([REACH], [{**HOME, "by": 20.0}])
    assert rack.run(8.0, is_moving)
    for ticks, board in enumerate(("cell", "task", "task.planner"), start=1):
        rack.after(150 * ticks, lambda board=board: rack.lose(board, 60))  # type: ignore[misc]
    assert rack.run(18.0, lambda rack: rack.read("cell.status").action == 2)
    assert 18.5 < rack.seconds <= 20.0 + 0.5
    assert rack.read("servo.status").position == pytest.approx(
        rack.tasks["servo"].level.context.robot.home, abs=0.01
    )
    assert rack.read("task.report").echo == 2000


def test_arm_holds_on_its_path_while_its_coordinator_is_lost_or_held_and_goes_on() -> None:
    rack = CellRack([SLOWLY])
    assert rack.run(8.0, is_moving)
    rack.lose("cell", 800)
    rack.run(1.9)
    assert (rack.task.state, rack.task.reason) == (
        State.HOLDING,
        "the coordinator is lost: held until it is back",
    )
    assert_rests(rack)
    rack.run(0.6)
    assert rack.task.state == State.EXECUTING
    operator = Operator(rack)
    operator.say("cell", Operation.HOLD)
    rack.run(1.9)
    assert rack.task.reason == rack.cell.reason == "cell held by the operator: `resume` releases it"
    assert_rests(rack)
    operator.say("cell", Operation.RESUME)
    assert rack.run(16.0, is_over)
    assert (rack.cell.state, rack.task.action, rack.report.echo) == (State.DONE, 1, 2000)


def assert_rests(rack: CellRack) -> None:
    """Find the arm at rest on its way."""
    assert np.abs(rack.read("servo.status").velocity).max() < 1e-3
    assert 0.0 < rack.read("elemental_move.status").progress < 1.0


@pytest.mark.parametrize(
    ("action", "error", "words"),
    [
        (
            {"do": "goto", "position": [1.5, 0.0, 0.6]},
            Error.UNREACHABLE,
            "goto [1.5, 0.0, 0.6]: out of reach: [1.5",
        ),
        ({**HOME, "by": 0.2}, Error.TOO_LATE, "home, by 0.45 s: it is 0.50 s already"),
    ],
)
def test_order_that_cannot_be_done_ends_both_runs_with_the_reason(
    action: dict[str, object], error: Error, words: str
) -> None:
    rack = CellRack([action])
    assert rack.run(8.0, is_over)
    assert (rack.cell.state, rack.cell.error, rack.cell.moves) == (State.ERROR, error, 0)
    assert rack.cell.reason.startswith(f"step 0 refused: puma: {words}")
    assert (rack.task.state, rack.task.error, rack.task.reason) == (
        State.ERROR,
        Error.GIVEN_UP,
        rack.cell.reason,
    )
    assert rack.read("primitive.status").done == 0
