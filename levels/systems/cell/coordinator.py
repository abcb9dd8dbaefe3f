"""A task level whose actions are carried out by the task levels of other racks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from rack.backplane.message import Message, MessageType, State, fill_counts
from rack.levels.level import Executor, Input, LevelContext, MadePorts, Output, Ports, Reading
from rack.levels.messages import TASK_STATUS, Error
from rack.levels.operator import OPERATOR_COMMAND, Operation, Orders
from rack.levels.systems.cell.actions import write_action
from rack.levels.systems.cell.agreement import Agreement, ArmAnswer
from rack.levels.systems.cell.messages import (
    CELL_ORDER,
    CELL_PROGRESS,
    CELL_REPORT,
    OrderVerb,
    Phase,
    Response,
)
from rack.levels.systems.cell.params import CoordinatorParams
from rack.levels.systems.cell.program import CellProgram
from rack.levels.tables import read_params


class Coordinator(Executor):
    """Has each step of its program carried out by all its arms, or by none.

    While an arm is lost, or an operator holds this level, the arms rest on their paths. `by` is the
    simulated time of this rack: it begins anew with each launch.
    """

    inputs = {
        "last_progress": Input(CELL_PROGRESS, "own.progress"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    # The progress first: a board killed before it has written its orders writes them when it is
    # back.
    outputs = {"progress": CELL_PROGRESS, "status": TASK_STATUS}
    commands = {Operation.HOLD: (), Operation.RESUME: ()}
    params = CoordinatorParams
    program = CellProgram

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._table = read_params(CoordinatorParams, context.params)
        program = CellProgram.model_validate(context.task)
        self._steps = [step.actions for step in program.step]
        self._agreement = Agreement(program.checksum, self._steps, 2.0 * context.period_s)
        self._operated = Orders(self.commands)
        self._started = False
        self._moves = 0  # moves of the steps done
        self._stage: tuple[object, ...] = ()  # all that changes while the program goes on
        self._moved_at = 0  # tick of the last such change

    @classmethod
    def made_ports(cls, params: Mapping[str, Any], types: Mapping[str, MessageType]) -> MadePorts:
        """Return the orders and the report of each arm."""
        try:
            arms = CoordinatorParams.model_validate(params).arms
        except ValidationError:
            return MadePorts(is_whole=False)
        reports = {f"report_{arm}": Input(CELL_REPORT, mailbox) for arm, mailbox in arms.items()}
        return MadePorts(reports, {f"order_{arm}": Output(CELL_ORDER) for arm in arms})

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Iterator[tuple[str, Any, str]]:
        """Yield arms of the program that the parameters lack."""
        known = read_params(CoordinatorParams, context.params).arms
        for k, step in enumerate(CellProgram.model_validate(context.task).step):
            for n, action in enumerate(step.do):
                if action.arm not in known:
                    why = f"lacks '{action.arm}', the arm of task.step[{k}].do[{n}]"
                    yield "params.arms", ", ".join(known), why

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Read what the arms report, go on with the program, order what is next."""
        if not self._started:
            self._recall(read)
        self._operated.take(read.operator)
        now_s = tick * self.context.tick_s
        readings = {arm: getattr(read, f"report_{arm}") for arm in self._table.arms}
        answers = {arm: answer_of(reading) for arm, reading in readings.items()}
        held = self._reason_to_hold(readings)
        self._go_on(readings, answers, now_s)
        waits = held or self._reason_to_wait(readings)
        self._check_progress(readings, waits, tick)
        for arm in self._table.arms:
            self._order(arm, held, getattr(write, f"order_{arm}"))
        self._agreement.write_to(write.progress)
        fill_counts(write.progress.record[["moves"]], (self._moves,))
        self._report(readings, waits, write.status)

    def _recall(self, read: Ports) -> None:
        """Continue from the last progress in the mailbox, after a restart of the board."""
        self._started = True
        if read.last_progress.is_there:
            self._agreement.recall(read.last_progress.value)
            self._moves = read.last_progress.value.moves

    def _go_on(
        self, readings: Mapping[str, Reading], answers: Mapping[str, ArmAnswer], now_s: float
    ) -> None:
        agreement = self._agreement
        if not self._steps:
            return
        step = agreement.step
        moves = self._moves_of_step(readings)[1]
        agreement.advance(answers, now_s)
        if agreement.step > step:
            self._moves += moves
        agreement.take_leave(answers, now_s, self._table.farewell_s)

    def _moves_of_step(self, readings: Mapping[str, Reading]) -> tuple[int, int]:
        """Return how many moves of the present step are done, of how many."""
        reports = [readings[arm].value for arm in self._agreement.partners]
        mine = [
            r
            for r in reports
            if (r.program, r.echo) == (self._agreement.program, self._agreement.order)
        ]
        return sum(r.moves_done for r in mine), sum(r.moves for r in mine)

    def _reason_to_hold(self, readings: Mapping[str, Reading]) -> str:
        """Return why the arms are to rest on their paths; empty: they are not."""
        if self._operated.standing is Operation.HOLD:
            return self._operated.keeps(self.context.board)
        if self._agreement.phase in (Phase.ENDING, Phase.OVER):
            return ""
        lost = next(
            (arm for arm, reading in readings.items() if reading.is_there and reading.is_lost), ""
        )
        return f"{lost} is lost: the program waits until it is back" if lost else ""

    def _reason_to_wait(self, readings: Mapping[str, Reading]) -> str:
        """Return why the program does not go on; empty: it does."""
        agreement = self._agreement
        if agreement.phase is Phase.ENDING:
            return agreement.reason
        if agreement.phase is Phase.AWAITING:
            silent = next((arm for arm, reading in readings.items() if not reading.is_there), "")
            return f"no report from {silent} yet" if silent else ""
        waiting = [arm for arm in agreement.partners if readings[arm].value.state == State.HOLDING]
        return f"{waiting[0]}: {readings[waiting[0]].value.reason}" if waiting else ""

    def _check_progress(self, readings: Mapping[str, Reading], waits: str, tick: int) -> None:
        """End the program when nothing has happened for too long, unless an operator keeps it from
        going on."""
        agreement = self._agreement
        reports = [reading.value for reading in readings.values()]
        operated = self._operated.standing is not Operation.NONE or any(
            report.operated for report in reports
        )
        stage = (
            agreement.phase,
            agreement.order,
            *((r.echo, r.response, r.moves_done, r.moves) for r in reports),
        )
        if operated or stage != self._stage or not self._steps:
            self._stage = stage
            self._moved_at = tick
        elif (tick - self._moved_at) * self.context.tick_s > self._table.stalled_s:
            awaited = waits or f"step {agreement.step}: {', '.join(agreement.partners)}"
            reason = f"nothing has happened for {self._table.stalled_s:g} s: {awaited}"
            agreement.end(Error.STALLED, reason, tick * self.context.tick_s)

    def _order(self, arm: str, held: str, order: Message) -> None:
        """Fill the order for one arm."""
        agreement = self._agreement
        what = agreement.verb(arm)
        if what in (OrderVerb.ASK, OrderVerb.DO, OrderVerb.CANCEL):
            write_action(self._steps[agreement.step][arm], order)
        is_none = what is OrderVerb.NONE
        order.id, order.program = (0, 0) if is_none else (agreement.order, agreement.program)
        order.what = what
        order.hold = bool(held)
        order.reason = agreement.reason if what is OrderVerb.END else held

    def _report(self, readings: Mapping[str, Reading], waits: str, status: Message) -> None:
        agreement = self._agreement
        status.state = self._state()
        if waits and status.state == State.EXECUTING:
            status.state = State.HOLDING
        is_over = agreement.phase is Phase.OVER
        status.error = agreement.error if is_over else Error.NONE
        status.reason = (
            agreement.reason if is_over else waits if status.state == State.HOLDING else ""
        )
        status.action = agreement.step
        status.actions = len(self._steps)
        done, moves = self._moves_of_step(readings)
        fill_counts(
            status.record[["moves_done", "moves"]], (self._moves + done, self._moves + moves)
        )
        if self._operated.standing is Operation.HOLD:
            self._operated.done()
        self._operated.report(status)

    def _state(self) -> State:
        if not self._steps:
            return State.IDLE
        if self._agreement.phase is Phase.OVER:
            return State.ERROR if self._agreement.error else State.DONE
        return State.EXECUTING


def answer_of(reading: Reading) -> ArmAnswer:
    """Return what a `CELL_REPORT` answers."""
    report: Message = reading.value
    return ArmAnswer(
        is_there=reading.is_there and not reading.is_lost,
        program=report.program,
        order=report.echo,
        response=Response(report.response),
        error=report.error,
        reason=report.reason,
        until=report.until,
    )
