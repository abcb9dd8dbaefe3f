"""The agreement on each step between a coordinator and its arms.

A step is asked of all its arms. Once each has answered POSSIBLE, all are told to do it; if one
refuses, all are ended. An answer holds until it says otherwise, so the step begins everywhere or
nowhere, however long messages take. An answer with a time may come too late to be acted on: then
all are cancelled, and asked again.

The id of an order names step and attempt. From what the arms report, a coordinator that remembers
nothing, after a new launch of its rack, knows which step is under way, and whether it had been
begun.

Both sides exchange whole states, never events, so a lost message only delays. What makes the arms
begin together, or not at all:

- An answer of an order is final: POSSIBLE turns into DOING by DO alone, into CANCELLED by CANCEL or
  another order.
- An arm begins nothing that it has not answered to be possible. After a new launch of its rack,
  which knows of no promise, it fails what it is asked to do.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from rack.levels.level import Reading
from rack.levels.messages import Error
from rack.levels.systems.coordination.messages import (
    CellProgress,
    CellReport,
    OrderVerb,
    Phase,
    Response,
)

ATTEMPTS = 1000
"""Ids of orders for one step."""
MAX_ATTEMPTS = 10
"""Times that a step is asked for before the program ends."""
NO = (Response.REFUSED, Response.FAILED)
BROKEN_OFF = (Response.CANCELLED, Response.STOPPED, Response.ENDED)
BEGUN = (Response.DOING, Response.DONE)
VERBS = {Phase.ASKING: OrderVerb.ASK, Phase.DOING: OrderVerb.DO, Phase.CANCELLING: OrderVerb.CANCEL}
"""What to say to the arms of a step."""
KEPT = ("phase", "step", "attempt", "error", "reason", "ending", "begun")
"""Attributes of an agreement that its `CellProgress` keeps."""


class Agreement:
    """Steps through a program with several arms. `program`: its checksum; `steps`: the arms of each
    step. The arms' answers are their `CellReport`s.
    """

    def __init__(
        self, program: int, steps: Sequence[Collection[str]], margin_s: float, farewell_s: float
    ) -> None:
        """`margin_s`: time in which an order reaches its arm; `farewell_s`: time that the arms have
        to confirm the end.
        """
        self.program = program
        self._steps = steps
        self._margin_s = margin_s
        self._farewell_s = farewell_s
        self._arms = list(dict.fromkeys(arm for step in steps for arm in step))
        self._answers: Mapping[str, Reading[CellReport]] = {}  # as of this cycle
        self._now_s = 0.0  # likewise, simulated time
        self.phase = Phase.AWAITING
        self.step = 0
        self.attempt = 0
        self.error = Error.NONE
        self.reason = ""
        # When every arm was there: the origin of the program's times, simulated time; 0: not yet
        self.begun = 0.0
        self.ending = 0.0  # since when the arms are ended, simulated time; 0: not yet

    def recall(self, last: CellProgress) -> None:
        """Continue from a `CellProgress`."""
        for name in KEPT:
            setattr(self, name, getattr(last, name))

    def write_to(self, progress: CellProgress) -> None:
        """Fill a `CellProgress`, but for the count of moves."""
        for name in KEPT:
            setattr(progress, name, getattr(self, name))

    @property
    def order(self) -> int:
        """Id of the present order."""
        return (self.step + 1) * ATTEMPTS + self.attempt

    @property
    def partners(self) -> Collection[str]:
        """The arms of the present step; none before the first and after the last one."""
        if self.phase not in VERBS or self.step >= len(self._steps):
            return ()
        return self._steps[self.step]

    def verb(self, arm: str) -> OrderVerb:
        """Return what to say to an arm."""
        if self.phase in (Phase.ENDING, Phase.OVER):
            return OrderVerb.END
        return VERBS[self.phase] if arm in self.partners else OrderVerb.NONE

    def advance(self, answers: Mapping[str, Reading[CellReport]], now_s: float) -> None:
        """Take one step forward, if the answers allow it; be over once every arm has confirmed the
        end, or had time to.
        """
        self._answers = answers
        self._now_s = now_s
        if self.phase is Phase.AWAITING:
            self._await()
        elif self.phase is Phase.ASKING:
            self._ask()
        elif self.phase is Phase.DOING:
            self._follow()
        elif self.phase is Phase.CANCELLING:
            self._cancel()
        if self.phase is Phase.ENDING:
            said = self._said(self._arms)
            is_confirmed = all(response is Response.ENDED for response in said.values())
            if is_confirmed or now_s - self.ending > self._farewell_s:
                self.phase = Phase.OVER

    def _said(self, arms: Collection[str]) -> dict[str, Response]:
        """Return the answers of these arms to the present order."""
        said = dict.fromkeys(arms, Response.NONE)
        for arm in arms:
            answer = self._answers[arm].message
            if (answer.program, answer.echo) == (self.program, self.order):
                said[arm] = Response(answer.response)
        return said

    def _are_there(self, arms: Collection[str]) -> bool:
        """Return whether all these arms report, and none is lost."""
        answers = [self._answers[arm] for arm in arms]
        return all(answer.is_there and not answer.is_lost for answer in answers)

    def _await(self) -> None:
        """Go on once every arm reports, with the step that the reports show, or with the end."""
        answers = [reading.message for reading in self._answers.values()]
        ours = [answer for answer in answers if answer.program == self.program]
        ended = [answer for answer in ours if answer.response == Response.ENDED]
        newest = max([answer.echo for answer in ended or ours], default=0)
        if newest // ATTEMPTS in range(1, len(self._steps) + 2):
            self.step = newest // ATTEMPTS - 1
            self.attempt = newest % ATTEMPTS
        if ended:
            self.end(Error(ended[0].error), ended[0].reason)
        elif self._are_there(self._arms):
            self.begun = self._now_s
            self._go_on()
        if self.phase is Phase.ASKING:
            # At once: an arm that has forgotten its promise must not be asked for it again.
            self._ask()

    def _go_on(self) -> None:
        if self.step < len(self._steps):
            self.phase = Phase.ASKING
        else:
            self.end(Error.NONE, "")

    def _ask(self) -> None:
        said = self._said(self.partners)
        if self._ends_by(said, NO):
            return
        if any(response in BROKEN_OFF for response in said.values()):
            self.phase = Phase.CANCELLING
        elif any(response in BEGUN for response in said.values()):
            self.phase = Phase.DOING  # told so by a launch before this one
        elif all(r is Response.POSSIBLE for r in said.values()) and self._are_there(said):
            arrives_s = self._now_s + self._margin_s
            times = [self._answers[arm].message.until for arm in said]
            in_time = all(arrives_s <= until_s for until_s in times if until_s)
            self.phase = Phase.DOING if in_time else Phase.CANCELLING

    def _follow(self) -> None:
        said = self._said(self.partners)
        if self._ends_by(said, (*NO, *BROKEN_OFF)):
            return
        if all(response is Response.DONE for response in said.values()):
            self.step += 1
            self.attempt = 0
            self._go_on()

    def _cancel(self) -> None:
        said = self._said(self.partners)
        if self._ends_by(said, NO):
            return
        if any(response not in (*BROKEN_OFF, Response.DONE) for response in said.values()):
            return
        begun = [arm for arm, response in said.items() if response is not Response.CANCELLED]
        self.attempt += 1
        if begun:
            why = f"step {self.step}: {begun[0]} had begun when it was cancelled"
            self.end(Error.GIVEN_UP, why)
        elif self.attempt == MAX_ATTEMPTS:
            why = f"step {self.step}: {MAX_ATTEMPTS} promises expired before all arms had answered"
            self.end(Error.TOO_LATE, why)
        else:
            self.phase = Phase.ASKING

    def _ends_by(self, said: Mapping[str, Response], kinds: Collection[Response]) -> bool:
        """End the program if an arm has given one of these answers; return whether it has."""
        for arm, response in said.items():
            if response in kinds:
                answer = self._answers[arm].message
                what = f"step {self.step} {response.name.lower()}: {arm}"
                reason = f"{what}: {answer.reason}".removesuffix(": ")
                self.end(Error(answer.error) or Error.GIVEN_UP, reason)
                return True
        return False

    def end(self, error: Error, reason: str) -> None:
        """End the program, and with it the runs of the arms."""
        if self.phase not in (Phase.ENDING, Phase.OVER):
            self.phase = Phase.ENDING
            self.error = error
            self.reason = reason
            self.ending = self._now_s


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

    def __init__(self, report: CellReport | None = None) -> None:
        """Begin without an order, or with that of a `CellReport`, after a restart of the board."""
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
            self.response = report.response
            if report.error:
                self.error = report.error
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
        early.
        """
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
