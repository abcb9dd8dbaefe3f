"""Task level that lets the task levels of other racks carry out its actions.

Its program, `[task]`, consists of steps, in which one or more arms act at the same time.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field, StringConstraints, ValidationError

from rack.backplane.message import Message, State, fill_counts
from rack.levels.level import (
    OPERATOR,
    ConfiguredPorts,
    Executor,
    Input,
    LevelContext,
    Mismatches,
    Output,
    Program,
    Reading,
)
from rack.levels.messages import Error, TaskStatus
from rack.levels.operator import HOLD_COMMANDS, MAX_JOINTS
from rack.levels.systems.coordination.actions import write_action
from rack.levels.systems.coordination.agreement import Agreement
from rack.levels.systems.coordination.messages import (
    OBJECT_BYTES,
    CellOrder,
    CellProgress,
    CellReport,
    OrderVerb,
    Phase,
)
from rack.levels.tables import (
    MailboxName,
    Positive,
    RobotConfig,
    SceneConfig,
    Table,
    read_params,
)
from rack.levels.task.program import Goto, Home, Transfer

MAX_STEPS = 1000
ArmName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,22}$")]
ARM = Field(description="arm that does it")


class ArmTransfer(Transfer):
    """Transfer that names its arm."""

    arm: ArmName = ARM


class ArmGoto(Goto):
    """Goto that names its arm."""

    arm: ArmName = ARM


class ArmHome(Home):
    """Motion to the home position that names its arm."""

    arm: ArmName = ARM


ArmAction = Annotated[ArmTransfer | ArmGoto | ArmHome, Field(discriminator="do")]


class CellStep(Table):
    """`[[task.step]]`: actions that begin together.

    They begin once every arm has answered that it can do its action in time.
    """

    do: tuple[ArmAction, ...]
    """actions, one for each arm that has a part in the step"""

    @property
    def actions(self) -> dict[str, ArmTransfer | ArmGoto | ArmHome]:
        """Dictionary from the name of each arm to its action."""
        return {action.arm: action for action in self.do}


class CellProgram(Program):
    """A program for several arms. Each step begins when the one before it is done."""

    step: tuple[CellStep, ...] = Field((), max_length=MAX_STEPS)
    """steps, done in their order"""

    @property
    def checksum(self) -> int:
        """Positive checksum by which orders and reports identify the program."""
        return zlib.crc32(self.model_dump_json().encode()) or 1

    def find_mismatches(self, robot: RobotConfig | None, scene: SceneConfig) -> Mismatches:
        """Yield key, value and reason of each mistake.

        Mistakes are steps without actions or with two actions of one arm, times that do not
        increase, and names or joints that do not fit into an order.
        """
        latest = 0.0
        for k, step in enumerate(self.step):
            arms: set[str] = set()
            if not step.do:
                yield f"step[{k}].do", [], "a step must have at least one action"
            for n, action in enumerate(step.do):
                key = f"step[{k}].do[{n}]"
                if action.arm in arms:
                    yield (
                        f"{key}.arm",
                        action.arm,
                        "this arm already has an action in this step",
                    )
                if action.by is not None and action.by <= latest:
                    yield (
                        f"{key}.by",
                        action.by,
                        f"must be later than {latest:g}, the time of an earlier step",
                    )
                # The order message has limited space for names and joints.
                if isinstance(action, ArmTransfer) and not (
                    action.object.isascii() and len(action.object) <= OBJECT_BYTES
                ):
                    yield (
                        f"{key}.object",
                        action.object,
                        f"an order can contain at most {OBJECT_BYTES} ASCII characters",
                    )
                if isinstance(action, ArmGoto) and len(action.joints or ()) > MAX_JOINTS:
                    yield (
                        f"{key}.joints",
                        list(action.joints or ()),
                        f"an order can contain at most {MAX_JOINTS} joints",
                    )
                arms.add(action.arm)
            latest = max([latest, *(action.by or 0.0 for action in step.do)])


class CoordinatorParams(Table):
    """The arms of a coordinator, and how long it waits for them."""

    arms: dict[ArmName, MailboxName] = Field(min_length=1)
    """mailbox with an arm's report, by the arm's name; its orders are in order_<name>"""
    stalled_s: Positive = 180.0
    """time without any progress after which the program ends, unless an operator holds it; longer
    than an arm's [s]"""
    farewell_s: Positive = 10.0
    """time that the arms have to come to rest and to confirm the end of the program [s]"""


class Coordinator(Executor):
    """Task level whose program is carried out by the arms of other racks.

    Either all arms of a step begin it, or none does. While an arm is lost, or an operator holds
    this level, the arms rest on their paths. The time `by` of an action counts from the moment when
    every arm has reported, and starts again with each launch of this rack.
    """

    last_progress = Input(CellProgress, "own.progress")
    operator = OPERATOR
    # The progress is written first: a board that is killed before it has written its orders will
    # write them after its restart.
    progress = Output(CellProgress)
    status = Output(TaskStatus)
    commands = HOLD_COMMANDS
    params = CoordinatorParams
    settings: CoordinatorParams
    program = CellProgram

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        program = CellProgram.model_validate(context.task)
        self._steps = [step.actions for step in program.step]
        margin_s = 2.0 * context.period_s
        self._agreement = Agreement(
            program.checksum, self._steps, margin_s, self.settings.farewell_s
        )
        # Reports of the arms in this cycle.
        self._readings: Mapping[str, Reading[CellReport]] = {}
        self._started = False
        # Number of moves of the steps that are done.
        self._moves = 0
        # Everything that changes while the program advances, and the tick of the last change.
        self._stage: tuple[object, ...] = ()
        self._moved_at = 0

    @classmethod
    def build_ports(
        cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]
    ) -> ConfiguredPorts:
        """Return an output for the orders to each arm and an input for its reports."""
        try:
            arms = CoordinatorParams.model_validate(params).arms
        except ValidationError:
            return ConfiguredPorts(is_complete=False)
        reports = {f"report_{arm}": Input(CellReport, mailbox) for arm, mailbox in arms.items()}
        return ConfiguredPorts(reports, {f"order_{arm}": Output(CellOrder) for arm in arms})

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield a mistake for each action whose arm is not among the parameters."""
        known_arms = read_params(CoordinatorParams, context.params).arms
        for k, step in enumerate(CellProgram.model_validate(context.task).step):
            for n, action in enumerate(step.do):
                if action.arm not in known_arms:
                    why = f"lacks '{action.arm}', the arm of task.step[{k}].do[{n}]"
                    yield "params.arms", ", ".join(known_arms), why

    def process(self, tick: int) -> None:
        """Read the reports of the arms, advance the program, and write the orders."""
        if not self._started:
            # After a restart of the board, continue from the last progress in the mailbox.
            self._started = True
            if self.last_progress.has_message:
                self._agreement.restore_progress(self.last_progress.message)
                self._moves = self.last_progress.message.moves
        self._orders.take_commands(self.operator)
        self._readings = {arm: self.ports[f"report_{arm}"] for arm in self.settings.arms}
        hold_reason = self._find_reason_to_hold()
        if self._steps:
            agreement = self._agreement
            step = agreement.step
            moves = self._count_moves()[1]
            agreement.advance_program(self._readings, tick * self.context.tick_s)
            if agreement.step > step:
                self._moves += moves
        wait_reason = hold_reason or self._find_reason_to_wait()
        if self._steps:
            self._check_progress(wait_reason, tick)
        for arm in self.settings.arms:
            self._write_order(arm, hold_reason, self.ports[f"order_{arm}"])
        self._agreement.save_progress(self.progress)
        fill_counts(self.progress.record[["moves"]], (self._moves,))
        self._write_status(wait_reason, self.status)

    def _count_moves(self) -> tuple[int, int]:
        """Return the number of completed moves and of all moves of the present step."""
        agreement = self._agreement
        reports = [self._readings[arm].message for arm in agreement.partners]
        present = agreement.program, agreement.order_id
        own_reports = [report for report in reports if (report.program, report.echo) == present]
        return sum(report.moves_done for report in own_reports), sum(
            report.moves for report in own_reports
        )

    def _find_reason_to_hold(self) -> str:
        """Return why the arms must stop on their paths, or an empty string."""
        if self._orders.is_holding:
            return self._orders.format_reason(self.context.board)
        if self._agreement.phase in (Phase.ENDING, Phase.OVER):
            return ""
        for arm, reading in self._readings.items():
            if reading.has_message and reading.is_lost:
                return f"{arm} is lost: the program waits until it is back"
        return ""

    def _find_reason_to_wait(self) -> str:
        """Return why the program does not advance, or an empty string."""
        agreement = self._agreement
        if agreement.phase is Phase.ENDING:
            return agreement.reason
        if agreement.phase is Phase.AWAITING:
            for arm, reading in self._readings.items():
                if not reading.has_message:
                    return f"no report from {arm} yet"
        for arm in agreement.partners:
            report = self._readings[arm].message
            if report.state == State.HOLDING:
                return f"{arm}: {report.reason}"
        return ""

    def _check_progress(self, wait_reason: str, tick: int) -> None:
        """End the program if neither orders nor reports have changed for `stalled_s`.

        Time during which an operator holds a level does not count.
        """
        agreement = self._agreement
        reports = [reading.message for reading in self._readings.values()]
        operated = self._orders.is_in_force or any(report.operated for report in reports)
        stage = (
            agreement.phase,
            agreement.order_id,
            *(
                (report.echo, report.response, report.moves_done, report.moves)
                for report in reports
            ),
        )
        if operated or stage != self._stage:
            self._stage = stage
            self._moved_at = tick
        elif (tick - self._moved_at) * self.context.tick_s > self.settings.stalled_s:
            awaited = wait_reason or f"step {agreement.step}: {', '.join(agreement.partners)}"
            reason = f"nothing has happened for {self.settings.stalled_s:g} s: {awaited}"
            agreement.end_program(Error.STALLED, reason)

    def _write_order(self, arm: str, hold_reason: str, order: CellOrder) -> None:
        """Write the order for one arm. The arm must hold if `hold_reason` is not empty."""
        agreement = self._agreement
        verb = agreement.choose_verb(arm)
        if verb in (OrderVerb.ASK, OrderVerb.DO, OrderVerb.CANCEL):
            write_action(self._steps[agreement.step][arm], order)
            if order.by:
                order.by += agreement.begun
        has_order = verb is not OrderVerb.NONE
        order.id = agreement.order_id if has_order else 0
        order.program = agreement.program if has_order else 0
        order.what = verb
        order.hold = bool(hold_reason)
        order.reason = agreement.reason if verb is OrderVerb.END else hold_reason

    def _write_status(self, wait_reason: str, status: TaskStatus) -> None:
        """Write the status of this level. `wait_reason` is empty if the program advances."""
        agreement = self._agreement
        status.state = State.IDLE
        status.error = Error.NONE
        status.reason = ""
        if agreement.phase is Phase.OVER:
            status.state = State.ERROR if agreement.error else State.DONE
            status.error = agreement.error
            status.reason = agreement.reason
        elif self._steps:
            status.state = State.HOLDING if wait_reason else State.EXECUTING
            status.reason = wait_reason
        status.action = agreement.step
        status.actions = len(self._steps)
        done, moves = self._count_moves()
        fill_counts(
            status.record[["moves_done", "moves"]], (self._moves + done, self._moves + moves)
        )
        if self._orders.is_holding:
            self._orders.report_done()
        self._orders.fill_status(status)
