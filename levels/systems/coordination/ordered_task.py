"""Task level that takes its actions from a coordinator, one order at a time.

Its planner plans the elemental moves of an order, or finds the reason why it cannot be done.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import StringConstraints, ValidationError

from rack.backplane.message import Message, State, fill_counts
from rack.backplane.rack_name import RACK_NAME
from rack.levels.errors import ProgramError, Refused
from rack.levels.level import ConfiguredPorts, Input, LevelContext, Output, Reading
from rack.levels.messages import Error, MoveStatus, TaskPlan, WorldState
from rack.levels.peer import PeerPresence, format_peer_port
from rack.levels.systems.coordination.actions import copy_action, read_action
from rack.levels.systems.coordination.agreement import TakenOrder
from rack.levels.systems.coordination.messages import (
    CellOrder,
    CellReport,
    CellRequest,
    Response,
)
from rack.levels.tables import MailboxName, Positive
from rack.levels.task.executor import TaskExecutor
from rack.levels.task.planner import TaskPlanner
from rack.levels.task.program import AnyAction, TaskConfig, TaskParams
from rack.levels.task.rehearsal import Rehearsed, compute_finish_times

RackName = Annotated[str, StringConstraints(pattern=f"^({RACK_NAME})?$")]
PLANNED = (Response.POSSIBLE, Response.DOING, Response.REFUSED)
"""Responses to an order that are based on its plan."""
MAX_STRAY_RAD = 0.005
"""Largest joint motion since the request of a plan for which the plan is still valid."""


class OrderedTaskParams(TaskParams):
    """Source of the orders of a task level, and the time for which its answers stay valid."""

    coordinator: RackName = ""
    """rack that gives the orders over the network, empty if a board of this rack does"""
    orders: MailboxName = "lan.orders"
    """mailbox with the orders"""
    decision: Positive = 5.0
    """time between an answer and the order to do it, for which a promised time holds [s]"""


class OrderedTaskExecutor(TaskExecutor):
    """Answers the orders of a coordinator and carries out the ones that it has accepted.

    While the coordinator is lost, it holds the arm on its path. It ends its run when ordered to, or
    when the coordinator has been absent for `stalled_s`.
    """

    world = Input(WorldState, "world.model")
    last_request = Input(CellRequest, "own.request")
    last_report = Input(CellReport, "own.report")
    # The report is written last, so that an order that it shows as begun is in the status.
    request = Output(CellRequest)
    report = Output(CellReport)
    params = OrderedTaskParams
    settings: OrderedTaskParams
    program = None

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        rack = self.settings.coordinator
        self._source = f"rack '{rack}'" if rack else "the coordinator"
        self._taken = TakenOrder(CellReport.zeros({}))
        # Id of the request whose plan is followed. 0 if none is.
        self._begun = 0
        self._orders_begun = 0
        self._orders_done = 0
        # Moves done, and number of moves, of the newest order that has begun.
        self._moves = 0, 0
        # Whether moves were withdrawn, so that the arm is held until another order begins.
        self._halted = False
        # First move that must not begin because the order is being interrupted.
        self._breaking_off: int | None = None
        # Whether the arm is held so that the order can be interrupted.
        self._rests = False
        # Why there are no orders, why the coordinator holds the arm, and why planning waits.
        self._absent = ""
        self._held = ""
        self._waits = ""
        self._is_end_reported = False
        # Plan that is followed without an order.
        self._nothing = TaskPlan.zeros(context.sizes)

    @classmethod
    def build_ports(
        cls, params: Mapping[str, Any], types: Mapping[str, type[Message]]
    ) -> ConfiguredPorts:
        """Return an input for orders and, over a network, one for the other rack's clock."""
        try:
            table = OrderedTaskParams.model_validate(params)
        except ValidationError:
            return ConfiguredPorts(is_complete=False)
        ports: dict[str, Input[Any]] = {"order": Input(CellOrder, table.orders)}
        if table.coordinator:
            ports["peer"] = Input(PeerPresence, f"lan.{format_peer_port(table.coordinator)}")
        return ConfiguredPorts(ports)

    def _read_first_actions(self) -> tuple[AnyAction, ...]:
        """Return no actions, because all of them come as orders."""
        return ()

    def _restore_state(self) -> None:
        """Continue from the last status, report and request after a restart of the board."""
        super()._restore_state()
        last = self.last_status.message
        self._orders_begun = last.actions
        self._orders_done = last.action
        self._moves = last.moves_done, last.moves
        if not self.last_report.has_message:
            return
        report = self.last_report.message
        self.report.copy_from(report)
        self.request.copy_from(self.last_request.message)
        self._taken = TakenOrder(report)
        self._halted = report.halted
        self._is_end_reported = self._taken.response is Response.ENDED
        if self._taken.is_under_way and report.moves:
            self._begun = self.request.id
            self._take_action(self.request)

    def _find_plan(self, tick: int) -> TaskPlan:
        """Process the newest order and return the plan to follow.

        The plan is empty if no order is being carried out.
        """
        self._read_order(self.ports["order"])
        self._waits = ""
        taken = self._taken
        request = self.request
        plan = self.plan.message
        if taken.needs_answer:
            self._answer_order(request, tick)
        elif taken.is_under_way and not self._begun:
            self._begin_plan(request)
        self.status.echo = plan.id if plan.id == request.id else 0
        # Report the earliest end, and how long the promise is valid, in the coordinator's time.
        report = self.report
        response = self._taken.response
        report.earliest = 0.0
        report.until = 0.0
        if plan.id == request.id and response in PLANNED:
            report.earliest = plan.earliest
        if response is Response.POSSIBLE and request.by:
            report.until = request.begin + request.ahead + request.by - plan.earliest
        self.report.operated = self.below.message.operated or self._orders.is_in_force
        return plan if self._begun and self._begun == plan.id else self._nothing

    def _read_order(self, reading: Reading[CellOrder]) -> None:
        """Process the newest order, or store the reason why there is none."""
        order = reading.message
        self._held = self._absent = ""
        if not reading.has_message:
            self._absent = f"no orders from {self._source} yet"
        elif reading.is_lost:
            self._absent = f"{self._source} is lost: held until it is back"
        else:
            self._taken.process_order(order.program, order.id, order.what, order.reason)
            if order.hold and self._taken.is_under_way:
                self._held = order.reason
        if self._taken.response is Response.ENDED:
            if self._is_end_reported and not self._error:
                self._error = self._taken.error
                self._reason = self._taken.reason
            self._absent = ""

    def _answer_order(self, request: CellRequest, tick: int) -> None:
        """Request a plan for an order as soon as the arm rests, and answer once the plan exists."""
        plan = self.plan.message
        taken = self._taken
        if (request.program, request.order) == (taken.program, taken.order):
            if plan.id == request.id and not plan.error:
                taken.set_response(Response.POSSIBLE)
            elif plan.id == request.id:
                taken.fail_order(plan.error, plan.reason)
            return
        self._waits = self._find_reason_not_to_plan()
        if self._waits:
            return
        order: CellOrder = self.ports["order"].message
        # The coordinator's simulated time minus the one of this rack.
        ahead_s = float(self.ports["peer"].message.ahead) if self.settings.coordinator else 0.0
        now_s = tick * self.context.tick_s
        try:
            action = read_action(order, self.context)
        except ProgramError as error:
            taken.fail_order(Error.UNREACHABLE, str(error))
            return
        if action.by is not None and action.by - ahead_s <= now_s:
            why = f"{action}, by {action.by:g} s: it is {now_s + ahead_s:.2f} s already"
            taken.fail_order(Error.TOO_LATE, why)
            return
        request.program = taken.program
        request.order = taken.order
        request.ahead = ahead_s
        copy_action(order, request)
        planned_s = (self.context.within_cycles + 1) * self.context.period_s
        self._request_plan(request, now_s + planned_s + self.settings.decision)

    def _request_plan(self, request: CellRequest, begin_s: float) -> None:
        """Request a plan for the action in `request` that can begin at simulated time `begin_s`."""
        request.id += 1
        request.begin = begin_s
        request.revision = self.world.message.revision
        request.start = self.below.message.start

    def _find_reason_not_to_plan(self) -> str:
        """Return why nothing can be planned at present, or an empty string."""
        if self._orders.is_in_force or not self.below.message.resting:
            return "the arm does not rest yet"
        if not self.world.message.revision:
            return "the world model knows nothing yet"
        if self.ports["order"].message.by and self.settings.coordinator:
            peer = self.ports["peer"]
            if not (peer.has_message and peer.message.uncertainty >= 0.0):
                return f"the clock of {self._source} has not been compared yet"
        return ""

    def _begin_plan(self, request: CellRequest) -> None:
        """Begin the promised plan, or request a new one if the arm or an object has moved."""
        if not self._actions:
            self._take_action(request)
        has_strayed = float(np.abs(self.below.message.start - request.start).max()) > MAX_STRAY_RAD
        if request.begin and (has_strayed or self.world.message.revision != request.revision):
            self._waits = self._find_reason_not_to_plan()
            if not self._waits:
                self._request_plan(request, 0.0)
        elif self.plan.message.id == request.id:
            self._begun = request.id
            self._done = 0
            self._halted = False
            self._window.renumber_plan(0)
            self._orders_begun += 1

    def _take_action(self, request: CellRequest) -> None:
        """Adopt the action and the clock offset of a request."""
        self._actions = (read_action(request, self.context),)
        self._ahead_s = request.ahead

    def _interrupt_program(self, plan: TaskPlan, below: MoveStatus) -> int:
        """Interrupt the order if an operator or the coordinator demands it.

        Returns:
            How many moves of the plan are done.
        """
        done = super()._interrupt_program(plan, below)
        self._halted = self._halted and not self._detour.move
        self._breaking_off = None
        has_rested = self._rests
        self._rests = False
        if self._taken.stops and self._detour.move:
            self._taken.set_response(Response.STOPPED)
        elif self._taken.stops:
            self._breaking_off, self._rests = self._window.find_interruption(plan, done, below)
            if has_rested and below.resting:
                self._taken.set_response(Response.STOPPED)
                self._halted = True
        return done

    def _find_first_barred_move(self, plan: TaskPlan) -> int:
        """Return the first move of the plan that must not begin."""
        until = super()._find_first_barred_move(plan)
        return until if self._breaking_off is None else min(until, self._breaking_off)

    def _find_reason_to_wait(self, below: Reading[MoveStatus]) -> str:
        """Return why the arm waits for an operator, orders or a plan. Empty if it does not."""
        waits = super()._find_reason_to_wait(below)
        if self._orders.is_in_force:
            return waits
        return self._absent or self._held or waits or self._waits

    def _check_progress(self, plan: TaskPlan, waits: str, tick: int) -> None:
        """End with an error if there has been no progress for too long."""
        # While the coordinator holds the arm, the coordinator decides for how long.
        if self._held:
            self._moved_at = tick
        else:
            super()._check_progress(plan, waits, tick)

    def _list_progress_values(self) -> tuple[int, ...]:
        """Return the values of the order whose changes count as progress."""
        return self._taken.order, self._taken.response, self._begun, not self._absent

    def _write_status(self, plan: TaskPlan, waits: str) -> None:
        """End an order that is done or has failed, then write status and report."""
        report = self.report
        status = self.status
        echo = self.status.echo
        self._end_order(plan)
        taken = self._taken
        if self._begun:
            self._moves = self._done, plan.count
            report.moves_done, report.moves = self._moves
        elif (report.program, report.echo) != (taken.program, taken.order):
            report.moves_done = 0
            report.moves = 0
        super()._write_status(plan, waits)
        status.echo = echo
        fill_counts(status.record[["action", "actions"]], (self._orders_done, self._orders_begun))
        status.moves_done, status.moves = self._moves
        report.program = taken.program
        report.echo = taken.order
        report.response = taken.response
        report.state = status.state
        report.error = taken.error
        report.halted = self._halted
        report.reason = taken.reason or waits
        if not taken.is_under_way:
            self._begun = 0
            self._actions = ()
        self._is_end_reported = taken.response is Response.ENDED

    def _format_reason(self, action: int, why: str) -> str:
        """Return a reason without the number of the action, because an order is one action."""
        return why.lstrip(",: ")

    def _end_order(self, plan: TaskPlan) -> None:
        """End an order that is done or has failed.

        An error that ends the whole run is kept. Any other error becomes the answer to the order.
        """
        taken = self._taken
        if self._error and (taken.needs_answer or taken.is_under_way):
            if self._absent and self._error is Error.STALLED:
                return
            taken.fail_order(self._error, self._reason)
            self._halted = self._halted or self._begun > 0
            self._error = Error.NONE
            self._reason = ""
        elif taken.is_under_way and plan.count and self._done == plan.count:
            taken.set_response(Response.DONE)
            self._orders_done += 1

    def _answer_operator(self, below: MoveStatus) -> None:
        """Write the command to the level below, with a hold if the arm must rest."""
        super()._answer_operator(below)
        is_held = self._taken.is_under_way and (self._absent or self._held)
        if not self._detour.move and (self._halted or self._rests or is_held):
            self.command.hold = True

    def _compute_state(self, plan: TaskPlan) -> State:
        """Return the state of this level for its status."""
        if self._error:
            return State.ERROR
        if self._taken.response is Response.ENDED:
            return State.DONE if self._is_end_reported else State.EXECUTING
        waits = self._taken.needs_answer or self._taken.is_under_way or self._absent
        return State.EXECUTING if waits else State.IDLE


class OrderedTaskPlanner(TaskPlanner):
    """Plans the action of an order for its executor, to begin at a given time or at once."""

    request = Input(CellRequest, "own.request")
    params = OrderedTaskParams
    program = None

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._id = 0
        # Simulated time before which the plan will not begin.
        self._begin_s = 0.0

    def _read_first_program(self) -> TaskConfig:
        """Return an empty program, because actions come as requests."""
        return TaskConfig()

    def wanted(self, tick: int) -> bool:
        """Return True if a request is unanswered, and the world is known and at rest."""
        request = self.request.message
        if request.id not in (0, self._id):
            # The executor has checked that the action suits the arm before it sent the request.
            action = read_action(request, self.context)
            self._program = TaskConfig(action=(action,))
            self._id = request.id
            self._plan = None
            self._begin_s = request.begin
            self._ahead_s = request.ahead
        return super().wanted(tick)

    def _format_reason(self, refused: Refused) -> str:
        """Return why an order is refused, without the number of the action."""
        return str(refused)

    def _compute_visible_s(self, tick: int) -> float:
        """Return the earliest simulated time in s at which the plan can begin."""
        return max(super()._compute_visible_s(tick), self._begin_s + self.context.period_s)

    def _check_deadlines(self, moves: Sequence[Rehearsed], visible_s: float) -> None:
        """Check that actions with a deadline can be completed in time, as the base class does.

        Also write to `output.earliest` the earliest time at which the order can be completed, on
        the clock of the coordinator.
        """
        super()._check_deadlines(moves, visible_s)
        unhurried = [Rehearsed(move._replace(by_s=0.0), duration_s) for move, duration_s in moves]
        self.output.earliest = (
            compute_finish_times(unhurried, visible_s, self.context, self.settings)[-1]
            + self._ahead_s
        )
