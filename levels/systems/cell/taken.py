"""The order that an arm has taken up, and its answer: the arm's part of the agreement on each step.

The other part is `rack.levels.systems.cell.agreement`. Both exchange whole states, never events, so
a lost message only delays. What makes the arms begin together, or not at all:

- An answer of an order is final: POSSIBLE turns into DOING by DO alone, into CANCELLED by CANCEL or
  another order.
- An arm begins nothing that it has not answered to be possible. After a new launch of its rack,
  which knows of no promise, it fails what it is asked to do.
"""

from __future__ import annotations

from rack.backplane.message import Message
from rack.levels.messages import Error
from rack.levels.systems.cell.messages import OrderVerb, Response

TAKEN = {
    OrderVerb.ASK: Response.NONE,
    OrderVerb.DO: Response.FAILED,
    OrderVerb.CANCEL: Response.CANCELLED,
    OrderVerb.END: Response.ENDED,
}
"""The response to an order that is new."""
NOT_PROMISED = "told to do what it has not promised: its rack was launched anew"


class TakenOrder:
    """One order at a time, by the checksum of its program and its id."""

    def __init__(self, report: Message | None = None) -> None:
        """Begin without an order, or with that of a `CELL_REPORT`, after a restart of the board."""
        self.program = 0
        self.order = 0
        self.response = Response.NONE
        # Of a refusal, a failure, or a program that ends early.
        self.error = Error.NONE
        self.reason = ""
        self.stops = False  # under way, and to be broken off
        if report is not None and report.echo:
            self.program = report.program
            self.order = report.echo
            self.response = Response(report.response)
            if report.error:
                self.error = Error(report.error)
                self.reason = report.reason

    @property
    def is_asked(self) -> bool:
        """Whether an answer is due."""
        return self.order > 0 and self.response is Response.NONE

    @property
    def is_under_way(self) -> bool:
        """Whether the arm carries it out."""
        return self.response is Response.DOING

    def hear(self, program: int, order: int, what: int, reason: str = "") -> None:
        """Follow what the newest message says of an order: an `OrderVerb`, and why a program ends
        early."""
        if not order or what not in TAKEN or self.response is Response.ENDED:
            return
        if what != OrderVerb.END:
            reason = ""
        is_same = (program, order) == (self.program, self.order)
        if self.is_under_way:
            self.stops = self.stops or not is_same or what in (OrderVerb.CANCEL, OrderVerb.END)
        elif what == OrderVerb.END or not is_same:
            self.program = program
            self.order = order
            self.answer(TAKEN[OrderVerb(what)], reason)
        elif what == OrderVerb.CANCEL and self.response in (Response.NONE, Response.POSSIBLE):
            self.answer(Response.CANCELLED)
        elif what == OrderVerb.DO and self.response is Response.POSSIBLE:
            self.answer(Response.DOING)
        elif what == OrderVerb.DO and self.is_asked:
            self.answer(Response.FAILED)
        if self.response is Response.FAILED and not self.error:
            self.error = Error.GIVEN_UP
            self.reason = NOT_PROMISED

    def fail(self, error: Error, reason: str) -> None:
        """Refuse the order to which an answer is due, or end the one under way."""
        response = Response.REFUSED if self.is_asked else Response.FAILED
        self.answer(response, reason, error)

    def answer(self, response: Response, reason: str = "", error: Error = Error.GIVEN_UP) -> None:
        """Answer the order; without a reason nothing is wrong."""
        self.response = response
        self.reason = reason
        self.stops = False
        self.error = error if reason else Error.NONE
