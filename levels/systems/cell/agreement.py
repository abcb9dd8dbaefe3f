"""The coordinator's part of the agreement on each step; the arms' part is
`rack.levels.systems.cell.taken`.

A step is asked of all its arms. Once each has answered POSSIBLE, all are told to do it; if one
refuses, all are ended. An answer holds until it says otherwise, so the step begins everywhere or
nowhere, however long messages take. An answer with a time may come too late to be acted on: then
all are cancelled, and asked again.

The id of an order names step and attempt. From what the arms report, a coordinator that remembers
nothing, after a new launch of its rack, knows which step is under way, and whether it had been
begun.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from rack.backplane.message import Message
from rack.levels.messages import Error
from rack.levels.systems.cell.messages import OrderVerb, Phase, Response

ATTEMPTS = 1000
"""Ids of orders for one step."""
MAX_ATTEMPTS = 10
"""Times that a step is asked for before the program ends."""
NO = (Response.REFUSED, Response.FAILED)
BROKEN_OFF = (Response.CANCELLED, Response.STOPPED, Response.ENDED)
BEGUN = (Response.DOING, Response.DONE)


class ArmAnswer(NamedTuple):
    """What an arm reports: to which order it answers what."""

    is_there: bool = False  # it reports, and is not lost
    program: int = 0
    order: int = 0
    response: Response = Response.NONE
    error: int = 0
    reason: str = ""
    until: float = (
        0.0  # simulated time of the coordinator's rack up to which POSSIBLE holds, s; 0: any time
    )


class Agreement:
    """Steps through a program with several arms. `program`: its checksum; `steps`: the arms of each
    step."""

    def __init__(self, program: int, steps: Sequence[Collection[str]], margin_s: float) -> None:
        """`margin_s`: time in which an order reaches its arm."""
        self.program = program
        self._steps = steps
        self._margin_s = margin_s
        self._arms = list(dict.fromkeys(arm for step in steps for arm in step))
        self.phase = Phase.AWAITING
        self.step = 0
        self.attempt = 0
        self.error = Error.NONE
        self.reason = ""
        self.ending_s = 0.0  # since when the arms are ended, simulated time; 0: not yet

    def recall(self, last: Message) -> None:
        """Continue from a `CELL_PROGRESS`."""
        self.phase = Phase(last.phase)
        self.step = last.step
        self.attempt = last.attempt
        self.error = Error(last.error)
        self.reason = last.reason
        self.ending_s = last.ending

    def write_to(self, progress: Message) -> None:
        """Fill a `CELL_PROGRESS`, but for the count of moves."""
        progress.phase = self.phase
        progress.step = self.step
        progress.attempt = self.attempt
        progress.error = self.error
        progress.reason = self.reason
        progress.ending = self.ending_s

    @property
    def order(self) -> int:
        """Id of the present order."""
        return (self.step + 1) * ATTEMPTS + self.attempt

    @property
    def partners(self) -> Collection[str]:
        """The arms of the present step; none before the first and after the last one."""
        return (
            self._steps[self.step] if self.phase in VERBS and self.step < len(self._steps) else ()
        )

    def verb(self, arm: str) -> OrderVerb:
        """Return what to say to an arm."""
        if self.phase in (Phase.ENDING, Phase.OVER):
            return OrderVerb.END
        return VERBS[self.phase] if arm in self.partners else OrderVerb.NONE

    def said(self, arm: str, answers: Mapping[str, ArmAnswer]) -> Response:
        """Return an arm's answer to the present order."""
        answer = answers[arm]
        is_ours = (answer.program, answer.order) == (self.program, self.order)
        return answer.response if is_ours else Response.NONE

    def advance(self, answers: Mapping[str, ArmAnswer], now_s: float) -> None:
        """Take one step forward, if the answers allow it."""
        if self.phase is Phase.AWAITING:
            self._await(answers, now_s)
        elif self.phase is Phase.ASKING:
            self._ask(answers, now_s)
        elif self.phase is Phase.DOING:
            self._follow(answers, now_s)
        elif self.phase is Phase.CANCELLING:
            self._cancel(answers, now_s)

    def _await(self, answers: Mapping[str, ArmAnswer], now_s: float) -> None:
        """Go on once every arm reports, with the step that the reports show, or with the end."""
        ours = [answer for answer in answers.values() if answer.program == self.program]
        ended = [answer for answer in ours if answer.response is Response.ENDED]
        newest = max([answer.order for answer in ended or ours], default=0)
        if newest // ATTEMPTS in range(1, len(self._steps) + 2):
            self.step = newest // ATTEMPTS - 1
            self.attempt = newest % ATTEMPTS
        if ended:
            self.end(Error(ended[0].error), ended[0].reason, now_s)
        elif all(answers[arm].is_there for arm in self._arms):
            self._go_on(now_s)
        if self.phase is Phase.ASKING:
            # At once: an arm that has forgotten its promise must not be asked for it again.
            self._ask(answers, now_s)

    def _go_on(self, now_s: float) -> None:
        if self.step < len(self._steps):
            self.phase = Phase.ASKING
        else:
            self.end(Error.NONE, "", now_s)

    def _ask(self, answers: Mapping[str, ArmAnswer], now_s: float) -> None:
        said = {arm: self.said(arm, answers) for arm in self.partners}
        if self._ends_by(said, NO, answers, now_s):
            return
        if any(response in BROKEN_OFF for response in said.values()):
            self.phase = Phase.CANCELLING
        elif any(response in BEGUN for response in said.values()):
            self.phase = Phase.DOING  # told so by a launch before this one
        elif all(said[arm] is Response.POSSIBLE and answers[arm].is_there for arm in said):
            times = [answers[arm].until for arm in said if answers[arm].until]
            in_time = now_s + self._margin_s <= min(times, default=now_s + self._margin_s)
            self.phase = Phase.DOING if in_time else Phase.CANCELLING

    def _follow(self, answers: Mapping[str, ArmAnswer], now_s: float) -> None:
        said = {arm: self.said(arm, answers) for arm in self.partners}
        if self._ends_by(said, (*NO, *BROKEN_OFF), answers, now_s):
            return
        if all(response is Response.DONE for response in said.values()):
            self.step = self.step + 1
            self.attempt = 0
            self._go_on(now_s)

    def _cancel(self, answers: Mapping[str, ArmAnswer], now_s: float) -> None:
        said = {arm: self.said(arm, answers) for arm in self.partners}
        if self._ends_by(said, NO, answers, now_s):
            return
        if any(response not in (*BROKEN_OFF, Response.DONE) for response in said.values()):
            return
        begun = [arm for arm, response in said.items() if response is not Response.CANCELLED]
        self.attempt += 1
        if begun:
            self.end(
                Error.GIVEN_UP,
                f"step {self.step}: {begun[0]} had begun when it was cancelled",
                now_s,
            )
        elif self.attempt == MAX_ATTEMPTS:
            why = f"step {self.step}: {MAX_ATTEMPTS} promises expired before all arms had answered"
            self.end(Error.TOO_LATE, why, now_s)
        else:
            self.phase = Phase.ASKING

    def _ends_by(
        self,
        said: Mapping[str, Response],
        kinds: Collection[Response],
        answers: Mapping[str, ArmAnswer],
        now_s: float,
    ) -> bool:
        """End the program if an arm has given one of these answers; return whether it has."""
        arm = next((arm for arm, response in said.items() if response in kinds), None)
        if arm is None:
            return False
        answer = answers[arm]
        word = said[arm].name.lower()
        reason = f"step {self.step} {word}: {arm}: {answer.reason}".removesuffix(": ")
        self.end(Error(answer.error) or Error.GIVEN_UP, reason, now_s)
        return True

    def end(self, error: Error, reason: str, now_s: float) -> None:
        """End the program, and with it the runs of the arms."""
        if self.phase not in (Phase.ENDING, Phase.OVER):
            self.phase = Phase.ENDING
            self.error = error
            self.reason = reason
            self.ending_s = now_s

    def take_leave(self, answers: Mapping[str, ArmAnswer], now_s: float, farewell_s: float) -> None:
        """Be over once every arm has confirmed the end, or had time to."""
        is_confirmed = all(self.said(arm, answers) is Response.ENDED for arm in self._arms)
        if self.phase is Phase.ENDING and (is_confirmed or now_s - self.ending_s > farewell_s):
            self.phase = Phase.OVER


VERBS = {Phase.ASKING: OrderVerb.ASK, Phase.DOING: OrderVerb.DO, Phase.CANCELLING: OrderVerb.CANCEL}
"""What to say to the arms of a step."""
