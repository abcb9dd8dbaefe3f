"""Agreement between a coordinator and its arms about each step of a program.

The coordinator asks all arms of a step. Once every arm has answered POSSIBLE, it tells all of them
to do the step. If one arm refuses, the program ends for all. The answer POSSIBLE is a promise: it
stays valid until the arm reports another answer, so a step begins everywhere or nowhere, however
long messages take. A promise may expire at a given time. If the order to do the step would arrive
too late for one arm, the step is cancelled for all arms and asked again.

The id of an order contains the step and the attempt. A coordinator that has lost its memory, after
a new launch of its rack, therefore learns from the reports of the arms which step is active and
whether it has begun.

Both sides exchange complete states instead of events, so a lost message only causes a delay. Two
rules ensure that the arms begin together or not at all:

- The answer to an order is final: POSSIBLE turns into DOING only by DO, and into CANCELLED only by
  CANCEL or another order.
- An arm begins nothing that it has not promised. After a new launch of its rack, which knows of no
  promise, it answers FAILED to an order to do something.
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
"""Number of order ids reserved for one step."""
MAX_ATTEMPTS = 10
"""Number of attempts after which the program ends."""
NEGATIVE = (Response.REFUSED, Response.FAILED)
INTERRUPTED = {Response.CANCELLED, Response.STOPPED, Response.ENDED}
BEGUN = {Response.DOING, Response.DONE}
VERBS = {Phase.ASKING: OrderVerb.ASK, Phase.DOING: OrderVerb.DO, Phase.CANCELLING: OrderVerb.CANCEL}
"""Verb of the orders to the arms of the step, by phase."""
SAVED_ATTRIBUTES = ("phase", "step", "attempt", "error", "reason", "ending", "begun")
"""Attributes of an agreement that are saved in `CellProgress`."""


class Agreement:
    """Leads several arms through the steps of a program.

    Attributes:
        program: Checksum of the program.
        phase: What the coordinator is doing.
        step: Number of steps that are done.
        attempt: Number of earlier attempts at the present step.
        error: Why the program ends early, or `Error.NONE`.
        reason: The error as text.
        begun: Simulated time in s at which every arm had reported. The program's times count from
            it. 0 before that.
        ending: Simulated time in s at which the coordinator began to end the runs of the arms. 0
            before that.
    """

    def __init__(
        self, program: int, steps: Sequence[Collection[str]], margin_s: float, farewell_s: float
    ) -> None:
        """Create the agreement before its first step.

        Args:
            program: Checksum of the program.
            steps: Arms of each step.
            margin_s: Time in s that an order needs to reach its arm.
            farewell_s: Time in s that the arms have to confirm the end.
        """
        self.program = program
        self._steps = steps
        self._margin_s = margin_s
        self._farewell_s = farewell_s
        self._arms = list(dict.fromkeys(arm for step in steps for arm in step))
        # Reports of the arms and simulated time of the present cycle.
        self._answers: Mapping[str, Reading[CellReport]] = {}
        self._now_s = 0.0
        self.phase = Phase.AWAITING
        self.step = 0
        self.attempt = 0
        self.error = Error.NONE
        self.reason = ""
        self.begun = 0.0
        self.ending = 0.0

    def restore_progress(self, last: CellProgress) -> None:
        """Continue from a saved state."""
        for name in SAVED_ATTRIBUTES:
            setattr(self, name, getattr(last, name))

    def save_progress(self, progress: CellProgress) -> None:
        """Save the state in a `CellProgress`. Its count of moves is not written."""
        for name in SAVED_ATTRIBUTES:
            setattr(progress, name, getattr(self, name))

    @property
    def order_id(self) -> int:
        """Id of the present order."""
        return (self.step + 1) * ATTEMPTS + self.attempt

    @property
    def partners(self) -> Collection[str]:
        """Arms of the present step. Empty before the first step and after the last one."""
        if self.phase not in VERBS or self.step >= len(self._steps):
            return ()
        return self._steps[self.step]

    def choose_verb(self, arm: str) -> OrderVerb:
        """Return the verb of the present order to an arm."""
        if self.phase in (Phase.ENDING, Phase.OVER):
            return OrderVerb.END
        return VERBS[self.phase] if arm in self.partners else OrderVerb.NONE

    def advance_program(self, answers: Mapping[str, Reading[CellReport]], now_s: float) -> None:
        """Advance the program if the answers allow it.

        A program that ends is over once every arm has confirmed the end, or has had enough time to
        confirm it.

        Args:
            answers: Newest report of each arm.
            now_s: Simulated time in s.
        """
        self._answers = answers
        self._now_s = now_s
        if self.phase is Phase.AWAITING:
            self._await_reports()
        elif self.phase is Phase.ASKING:
            self._evaluate_answers()
        elif self.phase is Phase.DOING:
            self._await_done()
        elif self.phase is Phase.CANCELLING:
            self._await_cancelled()
        if self.phase is Phase.ENDING:
            responses = self._read_responses(self._arms)
            is_confirmed = all(response is Response.ENDED for response in responses.values())
            if is_confirmed or now_s - self.ending > self._farewell_s:
                self.phase = Phase.OVER

    def _read_responses(self, arms: Collection[str]) -> dict[str, Response]:
        """Return the response of each arm to the present order. NONE if it has not answered."""
        responses = dict.fromkeys(arms, Response.NONE)
        for arm in arms:
            answer = self._answers[arm].message
            if (answer.program, answer.echo) == (self.program, self.order_id):
                responses[arm] = Response(answer.response)
        return responses

    def _are_present(self, arms: Collection[str]) -> bool:
        """Return True if all these arms report and none is lost."""
        answers = [self._answers[arm] for arm in arms]
        return all(answer.has_message and not answer.is_lost for answer in answers)

    def _await_reports(self) -> None:
        """Once every arm reports, continue with the newest step that appears in the reports.

        If a report shows that the program has already ended, end it at the coordinator as well.
        """
        answers = [reading.message for reading in self._answers.values()]
        own_answers = [answer for answer in answers if answer.program == self.program]
        ended_reports = [answer for answer in own_answers if answer.response == Response.ENDED]
        newest = max([answer.echo for answer in ended_reports or own_answers], default=0)
        if newest // ATTEMPTS in range(1, len(self._steps) + 2):
            self.step = newest // ATTEMPTS - 1
            self.attempt = newest % ATTEMPTS
        if ended_reports:
            self.end_program(Error(ended_reports[0].error), ended_reports[0].reason)
        elif self._are_present(self._arms):
            self.begun = self._now_s
            self._start_next_step()
        if self.phase is Phase.ASKING:
            # Evaluate the reports in the same cycle. Otherwise this cycle would ask again an arm
            # that already carries out the step, or that has lost its promise in a restart.
            self._evaluate_answers()

    def _start_next_step(self) -> None:
        """Start the next step, or end the program after the last one."""
        if self.step < len(self._steps):
            self.phase = Phase.ASKING
        else:
            self.end_program(Error.NONE, "")

    def _evaluate_answers(self) -> None:
        """Decide whether to do the step, cancel it, end the program or wait for more answers."""
        responses = self._read_responses(self.partners)
        if self._end_if_any(responses, NEGATIVE):
            return
        given = set(responses.values())
        if given & INTERRUPTED:
            self.phase = Phase.CANCELLING
        elif given & BEGUN:
            # An earlier launch of this rack has already told the arms to begin.
            self.phase = Phase.DOING
        elif given == {Response.POSSIBLE} and self._are_present(responses):
            arrives_s = self._now_s + self._margin_s
            times = [self._answers[arm].message.until for arm in responses]
            in_time = all(arrives_s <= until_s for until_s in times if until_s)
            self.phase = Phase.DOING if in_time else Phase.CANCELLING

    def _await_done(self) -> None:
        """Start the next step once all arms have done this one. End the program if an arm fails."""
        responses = self._read_responses(self.partners)
        if self._end_if_any(responses, (*NEGATIVE, *INTERRUPTED)):
            return
        if all(response is Response.DONE for response in responses.values()):
            self.step += 1
            self.attempt = 0
            self._start_next_step()

    def _await_cancelled(self) -> None:
        """Once all arms have cancelled the step, ask them again whether they can do it.

        End the program instead if an arm had begun or failed, or after `MAX_ATTEMPTS` attempts.
        """
        responses = self._read_responses(self.partners)
        if self._end_if_any(responses, NEGATIVE):
            return
        if any(response not in (*INTERRUPTED, Response.DONE) for response in responses.values()):
            return
        begun = [arm for arm, response in responses.items() if response is not Response.CANCELLED]
        self.attempt += 1
        if begun:
            why = f"step {self.step}: {begun[0]} had begun when it was cancelled"
            self.end_program(Error.GIVEN_UP, why)
        elif self.attempt == MAX_ATTEMPTS:
            why = f"step {self.step}: {MAX_ATTEMPTS} promises expired before all arms had answered"
            self.end_program(Error.TOO_LATE, why)
        else:
            self.phase = Phase.ASKING

    def _end_if_any(
        self, responses: Mapping[str, Response], fatal_responses: Collection[Response]
    ) -> bool:
        """End the program and return True if an arm has given one of these responses."""
        for arm, response in responses.items():
            if response in fatal_responses:
                answer = self._answers[arm].message
                event = f"step {self.step} {response.name.lower()}: {arm}"
                reason = f"{event}: {answer.reason}".removesuffix(": ")
                self.end_program(Error(answer.error) or Error.GIVEN_UP, reason)
                return True
        return False

    def end_program(self, error: Error, reason: str) -> None:
        """Begin to end the program and the runs of the arms, unless this has begun already."""
        if self.phase not in (Phase.ENDING, Phase.OVER):
            self.phase = Phase.ENDING
            self.error = error
            self.reason = reason
            self.ending = self._now_s


FIRST_RESPONSES = {
    OrderVerb.ASK: Response.NONE,
    OrderVerb.DO: Response.FAILED,
    OrderVerb.CANCEL: Response.CANCELLED,
    OrderVerb.END: Response.ENDED,
}
"""First response to a new order, by its verb."""
NOT_PROMISED = "told to do what it has not promised: its rack was launched anew"


class TakenOrder:
    """Newest order to an arm and the arm's response to it.

    The order is identified by the checksum of its program and by its id.

    Attributes:
        program: Checksum of the program. 0 if there is no order.
        order: Id of the order. 0 if there is none.
        response: Present response to the order.
        error: Why the order was refused or failed, or why the program ends early.
        reason: The error as text.
        stops: Whether the order is being carried out and must be interrupted.
    """

    def __init__(self, report: CellReport) -> None:
        """Continue from the arm's last report, which is empty at first."""
        self.program = report.program
        self.order = report.echo
        self.response = Response(report.response)
        self.error = Error(report.error)
        self.reason = report.reason if report.error else ""
        self.stops = False

    @property
    def needs_answer(self) -> bool:
        """Whether the order still needs an answer."""
        return self.order > 0 and self.response is Response.NONE

    @property
    def is_under_way(self) -> bool:
        """Whether the arm is carrying out the order."""
        return self.response is Response.DOING

    def process_order(self, program: int, order: int, verb: int, reason: str = "") -> None:
        """Update the response according to the order in the newest message.

        Args:
            program: Checksum of the program.
            order: Id of the order. 0 if there is none.
            verb: An `OrderVerb`.
            reason: Why the program ends early. Used with END only.
        """
        if not order or verb not in FIRST_RESPONSES or self.response is Response.ENDED:
            return
        if verb != OrderVerb.END:
            reason = ""
        is_same = (program, order) == (self.program, self.order)
        if self.is_under_way:
            self.stops = self.stops or not is_same or verb in (OrderVerb.CANCEL, OrderVerb.END)
        elif verb == OrderVerb.END or not is_same:
            self.program = program
            self.order = order
            self.set_response(FIRST_RESPONSES[OrderVerb(verb)], reason)
        elif verb == OrderVerb.CANCEL and self.response in (Response.NONE, Response.POSSIBLE):
            self.set_response(Response.CANCELLED)
        elif verb == OrderVerb.DO and self.response is Response.POSSIBLE:
            self.set_response(Response.DOING)
        elif verb == OrderVerb.DO and self.needs_answer:
            self.set_response(Response.FAILED)
        if self.response is Response.FAILED and not self.error:
            self.error = Error.GIVEN_UP
            self.reason = NOT_PROMISED

    def fail_order(self, error: Error, reason: str) -> None:
        """Answer REFUSED if the order still needs an answer, otherwise FAILED."""
        response = Response.REFUSED if self.needs_answer else Response.FAILED
        self.set_response(response, reason, error)

    def set_response(
        self, response: Response, reason: str = "", error: Error = Error.GIVEN_UP
    ) -> None:
        """Set the response to the order.

        Args:
            response: The response.
            reason: Why the order was refused or failed. Empty for other responses.
            error: Error code. Used only if there is a reason.
        """
        self.response = response
        self.reason = reason
        self.stops = False
        self.error = error if reason else Error.NONE
