"""A task level whose actions are carried out by the task levels of other racks, and its program,
`[task]`: steps, each with what one or more arms do in it at the same time.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import Field, StringConstraints, ValidationError

from rack.backplane.message import Message, State, fill_counts
from rack.levels.level import (
    Executor,
    Input,
    LevelContext,
    MadePorts,
    Misfits,
    Output,
    Program,
    Reading,
)
from rack.levels.messages import Error, TaskStatus
from rack.levels.operator import HOLDABLE, MAX_JOINTS, OperatorCommand, Orders
from rack.levels.systems.coordination.actions import write_action
from rack.levels.systems.coordination.agreement import Agreement
from rack.levels.systems.coordination.messages import (
    OBJECT_BYTES,
    CellOrder,
    CellProgress,
    CellReport,
    MailboxName,
    OrderVerb,
    Phase,
)
from rack.levels.tables import Positive, RobotConfig, SceneConfig, Table, read_params
from rack.levels.task.program import Goto, Home, Transfer

MAX_STEPS = 1000
ArmName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,22}$")]
ARM = Field(description="arm that does it")


class ArmTransfer(Transfer):
    """A transfer, by an arm."""

    arm: ArmName = ARM


class ArmGoto(Goto):
    """A goto, by an arm."""

    arm: ArmName = ARM


class ArmHome(Home):
    """The way home, of an arm."""

    arm: ArmName = ARM


ArmAction = Annotated[ArmTransfer | ArmGoto | ArmHome, Field(discriminator="do")]


class CellStep(Table):
    """`[[task.step]]`: actions that begin together, once every arm has answered that it can do its
    own by its time.
    """

    do: tuple[ArmAction, ...]
    """actions, one for each arm that has a part in the step"""

    @property
    def actions(self) -> dict[str, ArmTransfer | ArmGoto | ArmHome]:
        """The actions by arm."""
        return {action.arm: action for action in self.do}


class CellProgram(Program):
    """A program for several arms: steps, each begun when the one before it is done."""

    step: tuple[CellStep, ...] = Field((), max_length=MAX_STEPS)
    """steps, done in their order"""

    @property
    def checksum(self) -> int:
        """A number that two different programs hardly share, above 0."""
        return zlib.crc32(self.model_dump_json().encode()) or 1

    def misfits(self, robot: RobotConfig | None, scene: SceneConfig) -> Misfits:
        """Yield key, value and reason of steps without actions or with two for an arm, times that
        do not rise, and what is too long for an order.
        """
        latest = 0.0
        for k, step in enumerate(self.step):
            arms: set[str] = set()
            if not step.do:
                yield f"step[{k}].do", [], "has no action; permitted: one or more"
            for n, action in enumerate(step.do):
                place = f"step[{k}].do[{n}]"
                if action.arm in arms:
                    yield (
                        f"{place}.arm",
                        action.arm,
                        "has another action in this step; permitted: one action per arm",
                    )
                if action.by is not None and action.by <= latest:
                    yield (
                        f"{place}.by",
                        action.by,
                        f"an earlier step has {latest:g}; permitted: later than that",
                    )
                # An order holds names and joints of limited length.
                if isinstance(action, ArmTransfer) and not (
                    action.object.isascii() and len(action.object) <= OBJECT_BYTES
                ):
                    yield (
                        f"{place}.object",
                        action.object,
                        f"permitted in an order: at most {OBJECT_BYTES} ASCII characters",
                    )
                if isinstance(action, ArmGoto) and len(action.joints or ()) > MAX_JOINTS:
                    yield (
                        f"{place}.joints",
                        list(action.joints or ()),
                        f"permitted in an order: at most {MAX_JOINTS} joints",
                    )
                arms.add(action.arm)
            latest = max([latest, *(action.by or 0.0 for action in step.do)])


class CoordinatorParams(Table):
    """The arms that a coordinator orders about, and how long it waits for them."""

    arms: dict[ArmName, MailboxName] = Field(min_length=1)
    """mailbox with an arm's report, by the arm's name; its orders are in order_<name>"""
    stalled_s: Positive = 180.0
    """time without any progress after which the program ends, unless an operator holds it; longer
    than an arm's [s]"""
    farewell_s: Positive = 10.0
    """time that the arms have to come to rest and to confirm the end of the program [s]"""


class Coordinator(Executor):
    """Has each step of its program carried out by all its arms, or by none.

    While an arm is lost, or an operator holds this level, the arms rest on their paths. `by` counts
    from when every arm has reported: anew with each launch of this rack.
    """

    last_progress = Input(CellProgress, "own.progress")
    operator = Input(OperatorCommand, "own.operator")
    # The progress first: a board killed before it has written its orders writes them when it is
    # back.
    progress = Output(CellProgress)
    status = Output(TaskStatus)
    commands = HOLDABLE
    params = CoordinatorParams
    program = CellProgram

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._table = read_params(CoordinatorParams, context.params)
        program = CellProgram.model_validate(context.task)
        self._steps = [step.actions for step in program.step]
        margin_s = 2.0 * context.period_s
        self._agreement = Agreement(program.checksum, self._steps, margin_s, self._table.farewell_s)
        self._readings: Mapping[str, Reading[CellReport]] = {}  # of the arms, in this cycle
        self._operated = Orders(self.commands)
        self._started = False
        self._moves = 0  # moves of the steps done
        self._stage: tuple[object, ...] = ()  # all that changes while the program goes on
        self._moved_at = 0  # tick of the last such change

    @classmethod
    def made_ports(cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]) -> MadePorts:
        """Return the orders and the report of each arm."""
        try:
            arms = CoordinatorParams.model_validate(params).arms
        except ValidationError:
            return MadePorts(is_whole=False)
        reports = {f"report_{arm}": Input(CellReport, mailbox) for arm, mailbox in arms.items()}
        return MadePorts(reports, {f"order_{arm}": Output(CellOrder) for arm in arms})

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield arms of the program that the parameters lack."""
        known = read_params(CoordinatorParams, context.params).arms
        for k, step in enumerate(CellProgram.model_validate(context.task).step):
            for n, action in enumerate(step.do):
                if action.arm not in known:
                    why = f"lacks '{action.arm}', the arm of task.step[{k}].do[{n}]"
                    yield "params.arms", ", ".join(known), why

    def process(self, tick: int) -> None:
        """Read what the arms report, go on with the program, order what is next."""
        if not self._started:
            # Continue from the last progress in the mailbox, after a restart of the board.
            self._started = True
            if self.last_progress.is_there:
                self._agreement.recall(self.last_progress.message)
                self._moves = self.last_progress.message.moves
        self._operated.take(self.operator)
        self._readings = {arm: self.ports[f"report_{arm}"] for arm in self._table.arms}
        held = self._reason_to_hold()
        if self._steps:
            agreement = self._agreement
            step = agreement.step
            moves = self._moves_of_step()[1]
            agreement.advance(self._readings, tick * self.context.tick_s)
            if agreement.step > step:
                self._moves += moves
        waits = held or self._reason_to_wait()
        if self._steps:
            self._check_progress(waits, tick)
        for arm in self._table.arms:
            self._order(arm, held, self.ports[f"order_{arm}"])
        self._agreement.write_to(self.progress)
        fill_counts(self.progress.record[["moves"]], (self._moves,))
        self._report(waits, self.status)

    def _moves_of_step(self) -> tuple[int, int]:
        """Return how many moves of the present step are done, of how many."""
        agreement = self._agreement
        reports = [self._readings[arm].message for arm in agreement.partners]
        mine = [r for r in reports if (r.program, r.echo) == (agreement.program, agreement.order)]
        return sum(r.moves_done for r in mine), sum(r.moves for r in mine)

    def _reason_to_hold(self) -> str:
        """Return why the arms are to rest on their paths; empty: they are not."""
        if self._operated.holds:
            return self._operated.keeps(self.context.board)
        if self._agreement.phase in (Phase.ENDING, Phase.OVER):
            return ""
        for arm, reading in self._readings.items():
            if reading.is_there and reading.is_lost:
                return f"{arm} is lost: the program waits until it is back"
        return ""

    def _reason_to_wait(self) -> str:
        """Return why the program does not go on; empty: it does."""
        agreement = self._agreement
        if agreement.phase is Phase.ENDING:
            return agreement.reason
        if agreement.phase is Phase.AWAITING:
            for arm, reading in self._readings.items():
                if not reading.is_there:
                    return f"no report from {arm} yet"
        for arm in agreement.partners:
            report = self._readings[arm].message
            if report.state == State.HOLDING:
                return f"{arm}: {report.reason}"
        return ""

    def _check_progress(self, waits: str, tick: int) -> None:
        """End the program when nothing has happened for too long, unless an operator keeps it from
        going on.
        """
        agreement = self._agreement
        reports = [reading.message for reading in self._readings.values()]
        operated = self._operated.stands or any(report.operated for report in reports)
        stage = (
            agreement.phase,
            agreement.order,
            *((r.echo, r.response, r.moves_done, r.moves) for r in reports),
        )
        if operated or stage != self._stage:
            self._stage = stage
            self._moved_at = tick
        elif (tick - self._moved_at) * self.context.tick_s > self._table.stalled_s:
            awaited = waits or f"step {agreement.step}: {', '.join(agreement.partners)}"
            reason = f"nothing has happened for {self._table.stalled_s:g} s: {awaited}"
            agreement.end(Error.STALLED, reason)

    def _order(self, arm: str, held: str, order: CellOrder) -> None:
        """Fill the order for one arm."""
        agreement = self._agreement
        what = agreement.verb(arm)
        if what in (OrderVerb.ASK, OrderVerb.DO, OrderVerb.CANCEL):
            write_action(self._steps[agreement.step][arm], order)
            if order.by:
                order.by += agreement.begun
        is_spoken_to = what is not OrderVerb.NONE
        order.id = agreement.order if is_spoken_to else 0
        order.program = agreement.program if is_spoken_to else 0
        order.what = what
        order.hold = bool(held)
        order.reason = agreement.reason if what is OrderVerb.END else held

    def _report(self, waits: str, status: TaskStatus) -> None:
        agreement = self._agreement
        status.state = State.IDLE
        status.error = Error.NONE
        status.reason = ""
        if agreement.phase is Phase.OVER:
            status.state = State.ERROR if agreement.error else State.DONE
            status.error = agreement.error
            status.reason = agreement.reason
        elif self._steps:
            status.state = State.HOLDING if waits else State.EXECUTING
            status.reason = waits
        status.action = agreement.step
        status.actions = len(self._steps)
        done, moves = self._moves_of_step()
        fill_counts(
            status.record[["moves_done", "moves"]], (self._moves + done, self._moves + moves)
        )
        if self._operated.holds:
            self._operated.done()
        self._operated.report(status)
