"""An ordered task level alone: the test gives orders, and plays the level below and the world."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.message import Message, State
from rack.levels.level import Executor, Input, Output
from rack.levels.messages import Error, MoveStatus, ServoStatus, TaskCommand, Verb, WorldState
from rack.levels.peer import PeerPresence
from rack.levels.systems.coordination import OrderedTaskExecutor, OrderedTaskPlanner
from rack.levels.systems.coordination.actions import write_action
from rack.levels.systems.coordination.messages import CellOrder, OrderVerb, Response
from rack.levels.task.program import Goto, Home, Transfer
from tests.levels.arms import cell, config
from tests.levels.lockstep import BoardSpec, Lockstep

ROBOT, SCENE = config("puma560")
EVERY, MOVE_EVERY = 100, 20
MOVE_CYCLES = 25
"""Cycles that the level below needs for a move."""
TRANSFER = Transfer(object="block1", to=(0.50, -0.20, 0.475))
HOME = Home()
Action = Transfer | Goto | Home


class PlayedMoves(Executor):
    """A level below that does every move in `MOVE_CYCLES`, if it is not held."""

    above = Input(TaskCommand, "above.command")
    status = Output(MoveStatus)
    spent = 0
    stray_rad = 0.0
    """How far the first joint has been moved by somebody else."""

    def process(self, tick: int) -> None:
        command, status = self.above.message, self.status
        ids = [int(serial) for serial in command.moves["id"][: command.count]]
        if ids and ids[0] > status.done + 1:
            status.done, self.spent = ids[0] - 1, 0
        moves = status.done + 1 in ids and not command.hold
        self.spent += moves
        if self.spent >= MOVE_CYCLES:
            status.done, self.spent = status.done + 1, 0
        status.current = status.done + 1 if self.spent else 0
        status.progress, status.resting = self.spent / MOVE_CYCLES, not moves
        status.operator = command.operator
        status.start[0] = self.stray_rad


class OrderBench(Lockstep):
    """The task level of an arm; orders come from the rack `cell`, whose time is `ahead`."""

    def __init__(self, ahead: float = 0.0, **params: Any) -> None:
        outside = {
            "lan.orders": CellOrder,
            "lan.peer_cell": PeerPresence,
            "servo.status": ServoStatus,
            "world.model": WorldState,
        }
        kinds, table = (OrderedTaskExecutor, OrderedTaskPlanner), {"coordinator": "cell", **params}
        boards = [
            BoardSpec("task", EVERY, *kinds, 4, below="elemental_move", params=table),
            BoardSpec("elemental_move", MOVE_EVERY, PlayedMoves, above="task"),
        ]
        super().__init__(boards, ROBOT, SCENE, outside=outside)
        self.show("servo.status", target=np.array(ROBOT.home))
        self.show("lan.peer_cell", ahead=ahead)
        self.revision = 0
        self.see()

    def see(self) -> None:
        """Show the world, with a new revision."""
        self.revision += 1
        self.show_start(cell("puma560"), self.revision)

    def order(
        self, what: OrderVerb, action: Action = HOME, number: int = 1000, **said: Any
    ) -> None:
        order = self.message("lan.orders")
        write_action(action, order)
        order.program, order.id, order.what = 1, number, what
        for name, value in said.items():
            setattr(order, name, value)
        self.write("lan.orders", order)

    def until(self, *responses: Response, seconds: float = 20.0) -> Message:
        """Run until the report says one of these; return it."""
        found = self.run(seconds, lambda rack: rack.read("task.report").response in responses)
        assert found, self.report
        return self.report

    def ask_and_do(self, action: Action, number: int = 1000) -> None:
        self.order(OrderVerb.ASK, action, number)
        self.until(Response.POSSIBLE)
        self.order(OrderVerb.DO, action, number)
        self.until(Response.DOING)

    @property
    def report(self) -> Message:
        return self.read("task.report")

    @property
    def status(self) -> Message:
        return self.read("task.status")

    def verb(self) -> Verb:
        command, current = self.read("task.command"), self.read("elemental_move.status").current
        shown = command.moves[: command.count]
        verbs = shown["verb"][shown["id"] == current]
        return Verb(int(verbs[0])) if len(verbs) else Verb.NONE


def test_times_refer_to_the_clock_of_the_coordinators_rack() -> None:
    bench = OrderBench(ahead=100.0)
    bench.run(1.0)
    bench.order(OrderVerb.ASK, Home(by=114.0))
    report = bench.until(Response.POSSIBLE)
    assert 105.0 < report.earliest < 114.0
    assert report.until == pytest.approx(bench.read("task.request").begin + 214.0 - report.earliest)
    bench.order(OrderVerb.ASK, Home(by=103.0), 1001)
    report = bench.until(Response.REFUSED)
    assert report.reason == f"home, by 103 s: the earliest is {report.earliest:.2f} s"
    assert report.error == Error.TOO_LATE


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "stray", "plans"),
    [(False, 0.0, 1), (True, 0.0, 2), (False, 0.004, 1), (False, 0.006, 2)],
)
def test_promised_plan_is_renewed_after_a_change(changes: bool, stray: float, plans: int) -> None:
    bench = OrderBench()
    bench.order(OrderVerb.ASK, TRANSFER)
    bench.until(Response.POSSIBLE)
    if changes:
        bench.see()
    bench.tasks["elemental_move"].level.stray_rad = stray
    bench.run(0.1)
    bench.order(OrderVerb.DO, TRANSFER)
    assert bench.until(Response.DONE).moves_done == 8
    assert bench.read("task.plan").id == bench.boxes["task.plan"].at(bench.tick)[0] == plans


def test_order_is_interrupted_only_after_the_work_on_the_object() -> None:
    bench = OrderBench()
    bench.ask_and_do(TRANSFER)
    assert bench.run(20.0, lambda rack: bench.verb() is Verb.APPROACH)
    bench.order(OrderVerb.CANCEL, TRANSFER)
    report = bench.until(Response.STOPPED)
    assert (report.moves_done, report.halted, bench.read("task.command").hold) == (4, 1, 1)
    done = bench.read("elemental_move.status").done
    bench.run(2.0)
    assert bench.read("elemental_move.status").done == done
    bench.ask_and_do(HOME, 1001)
    assert (bench.until(Response.DONE).halted, bench.read("task.command").hold) == (0, 0)
    # One that is not begun is forgotten.
    bench.order(OrderVerb.ASK, HOME, 1002)
    bench.until(Response.POSSIBLE)
    bench.order(OrderVerb.CANCEL, HOME, 1002)
    bench.until(Response.CANCELLED)
    bench.order(OrderVerb.DO, HOME, 1002)
    bench.run(3.0)
    assert bench.report.response == Response.CANCELLED


def test_free_motion_is_interrupted_at_once_at_the_end_of_the_program() -> None:
    bench = OrderBench()
    bench.ask_and_do(TRANSFER)
    assert bench.run(5.0, lambda rack: bench.verb() is Verb.MOVE)
    bench.order(OrderVerb.END, reason="k1607 has failed")
    assert bench.run(3.0, lambda rack: rack.read("task.status").state == State.ERROR)
    assert (bench.report.response, bench.status.error) == (Response.ENDED, Error.GIVEN_UP)
    assert (bench.status.reason, bench.status.moves) == ("k1607 has failed", 8)
    assert bench.read("elemental_move.status").done == 1


def test_arm_holds_while_its_orders_are_lost_and_then_continues() -> None:
    bench = OrderBench(stalled_s=3.0)
    bench.order(OrderVerb.NONE, number=0)
    bench.run(8.0)
    assert bench.status.state == State.IDLE
    bench.ask_and_do(TRANSFER)
    bench.order(OrderVerb.DO, TRANSFER, hold=1, reason="k1607 is lost")
    bench.run(8.0)
    assert (bench.status.state, bench.status.reason) == (State.HOLDING, "k1607 is lost")
    bench.order(OrderVerb.DO, TRANSFER)
    bench.run(1.0)
    bench.boxes["lan.orders"].lost = True
    bench.run(1.0)
    why = "rack 'cell' is lost: held until it is back"
    assert (bench.status.state, bench.status.reason) == (State.HOLDING, why)
    assert bench.read("task.command").hold
    bench.boxes["lan.orders"].lost = False
    assert bench.until(Response.DONE).moves_done == 8


@pytest.mark.slow
@pytest.mark.parametrize("board", ["task", "task.planner"])
@pytest.mark.parametrize("cycle", range(1, 14, 3))
def test_order_is_done_once_whenever_a_board_dies(board: str, cycle: int) -> None:
    bench = OrderBench()
    bench.after(cycle * EVERY + 10, lambda: bench.lose(board, 60))
    bench.ask_and_do(HOME)
    assert bench.until(Response.DONE).moves_done == 1
    bench.run(1.0)
    assert (bench.status.action, bench.status.actions) == (1, 1)


def test_order_without_progress_fails_with_the_reason() -> None:
    bench = OrderBench(stalled_s=3.0)
    bench.ask_and_do(TRANSFER)
    bench.lose("elemental_move", 100_000)
    report = bench.until(Response.FAILED)
    assert (report.error, report.halted) == (Error.STALLED, 1)
    assert report.reason.startswith("nothing has moved for 3 s: no status from the level below")
    assert bench.status.state != State.ERROR
