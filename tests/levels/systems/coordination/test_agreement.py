"""The agreement of a coordinator and arms on each step, through losses and restarts."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rack.backplane.message import Message
from rack.levels.level import Reading, Verdict
from rack.levels.messages import Error
from rack.levels.systems.coordination.agreement import (
    ATTEMPTS,
    BEGUN,
    MAX_ATTEMPTS,
    Agreement,
    TakenOrder,
)
from rack.levels.systems.coordination.messages import (
    CellProgress,
    CellReport,
    OrderVerb,
    Phase,
    Response,
)

PROGRAM, ARMS = 7, ("puma", "k1607", "third")
STEPS = (("puma", "k1607"), ("third",), ("k1607", "puma", "third"))
SILENCE = Reading(CellReport.zeros({}), Verdict.NONE)
FINISH = 400
"""Cycles after which an undisturbed program is over."""


def at(order: int) -> int:
    """Return the step of an order."""
    return order // ATTEMPTS - 1


@dataclass
class PlayedArm:
    """An arm that needs a cycle to plan and two to move; it refuses, and fails in, some steps."""

    refuses: frozenset[int] = frozenset()
    fails: frozenset[int] = frozenset()
    keeps_s: float = 0.0  # how long it keeps a promise; 0: for good
    taken: TakenOrder = field(init=False)
    done: Counter[int] = field(default_factory=Counter)
    stopped: int = 0
    moved: int = 0
    until: float = 0.0

    def __post_init__(self) -> None:
        self.report = CellReport.zeros({})
        self.taken = TakenOrder(self.report)

    def cycle(self, order: tuple[int, OrderVerb, str], now_s: float) -> Reading:
        """Take up what is said; return the report."""
        taken = self.taken
        asked, was_under_way = taken.needs_answer, taken.is_under_way
        taken.process_order(PROGRAM if order[0] else 0, *order)
        if taken.needs_answer and asked and at(taken.order) in self.refuses:
            taken.fail_order(Error.NO_PATH, "something is in the way")
        elif taken.needs_answer and asked:
            taken.set_response(Response.POSSIBLE)
            self.until = now_s + self.keeps_s if self.keeps_s else 0.0
        elif taken.is_under_way:
            self._move(is_first=not was_under_way)
        self.report.program, self.report.echo = taken.program, taken.order
        self.report.response = taken.response
        self.report.error, self.report.reason = taken.error, taken.reason
        self.report.until = self.until
        answer = Message(self.report.record.dtype)
        answer.copy_from(self.report)
        return Reading(answer, Verdict.NEW)

    def _move(self, is_first: bool) -> None:
        step = at(self.taken.order)
        self.moved = 0 if is_first else self.moved + 1
        if self.taken.stops:
            self.taken.set_response(Response.STOPPED)
            self.stopped += 1
        elif self.moved == 2 and step in self.fails:
            self.taken.fail_order(Error.GRASP_MISSED, "holds nothing")
        elif self.moved == 2:
            self.taken.set_response(Response.DONE)
            self.done[step] += 1

    def restart(self) -> None:
        """Remember only the last report."""
        self.taken, self.moved = TakenOrder(self.report), 0

    def launch(self) -> None:
        """Remember nothing."""
        self.report.clear()
        self.restart()


class Play:
    """The program played cycle by cycle. All read the newest message of another that came."""

    def __init__(self, **arms: PlayedArm) -> None:
        self.arms = {name: arms.get(name, PlayedArm()) for name in ARMS}
        self.agreement = Agreement(PROGRAM, STEPS, margin_s=1.0, farewell_s=50.0)
        self.progress = CellProgress.zeros({})
        self.orders = dict.fromkeys(ARMS, (0, OrderVerb.NONE, ""))
        self.answers = dict.fromkeys(ARMS, SILENCE)
        self.now_s = 0.0

    def cycle(self, lost: frozenset[str] = frozenset()) -> None:
        """Run a cycle. `lost`: messages that get lost: "puma": its report, ">puma": its order."""
        self.now_s += 1.0
        for name, arm in self.arms.items():
            answer = arm.cycle(self.orders[name], self.now_s)
            if name not in lost:
                self.answers[name] = answer
        self.agreement.advance_program(self.answers, self.now_s)
        self.agreement.save_progress(self.progress)
        for name in ARMS:
            if f">{name}" not in lost:
                verb = self.agreement.choose_verb(name)
                self.orders[name] = self.agreement.order_id, verb, self.agreement.reason
        self.check()

    def restart(self, who: str) -> None:
        """Restart an arm's board, the coordinator's ("cell"), or its whole rack ("launch")."""
        if who in self.arms:
            self.arms[who].restart()
            return
        self.agreement = Agreement(PROGRAM, STEPS, margin_s=1.0, farewell_s=50.0)
        if who == "cell":
            self.agreement.restore_progress(self.progress)
        else:
            self.answers = dict.fromkeys(ARMS, SILENCE)

    def check(self) -> None:
        """No arm does an order that another one has refused; none does a step twice."""
        taken = [arm.taken for arm in self.arms.values()]
        begun = {one.order for one in taken if one.response in BEGUN}
        assert not begun & {one.order for one in taken if one.response is Response.REFUSED}
        assert all(count == 1 for arm in self.arms.values() for count in arm.done.values())

    def finish(self) -> None:
        """Run undisturbed until the program is over."""
        for _ in range(FINISH):
            self.cycle()
            if self.agreement.phase is Phase.OVER:
                break
        assert self.agreement.phase is Phase.OVER
        assert all(arm.taken.response is Response.ENDED for arm in self.arms.values())

    def done_by(self, arms: tuple[str, ...], step: int) -> set[int]:
        """Return how often each of these arms has done a step."""
        return {self.arms[arm].done[step] for arm in arms}


Events = list[frozenset[str] | str]
MESSAGES = [*ARMS, *(f">{arm}" for arm in ARMS)]
LOST = st.frozensets(st.sampled_from(MESSAGES))
QUIET = st.integers(0, 30).map(lambda cycles: [frozenset[str]()] * cycles)
"""Cycles without losses: the program takes about 20."""


def after_a_while(*restarted: str) -> st.SearchStrategy[Events]:
    """Return what happens: losses, and restarts of these."""
    disturbed = st.lists(st.one_of(LOST, st.sampled_from(restarted)), max_size=30)
    return st.tuples(QUIET, disturbed).map(lambda parts: [*parts[0], *parts[1]])


EVENTS = after_a_while(*ARMS, "cell", "launch")
STEADY = after_a_while(*ARMS, "cell")
SOME_STEPS = st.frozensets(st.integers(0, len(STEPS) - 1), max_size=1)


def disturb(play: Play, events: Events) -> None:
    """Play through losses and restarts."""
    for event in events:
        if isinstance(event, str):
            play.restart(event)
        else:
            play.cycle(event)


@given(EVENTS)
@settings(max_examples=40)
def test_program_is_done_once_by_all_whatever_is_lost_and_restarted(events: Events) -> None:
    play = Play()
    disturb(play, events)
    play.finish()
    assert (play.agreement.error, play.agreement.step) == (Error.NONE, len(STEPS))
    assert all(play.done_by(arms, step) == {1} for step, arms in enumerate(STEPS))


@given(EVENTS, SOME_STEPS, SOME_STEPS)
@settings(max_examples=40)
def test_step_that_one_arm_refuses_is_begun_by_none(
    events: Events, puma: frozenset[int], third: frozenset[int]
) -> None:
    play = Play(puma=PlayedArm(refuses=puma), third=PlayedArm(refuses=third))
    disturb(play, events)
    play.finish()
    by_arm = {"puma": puma, "third": third}
    asked = [(step, arm) for step, arms in enumerate(STEPS) for arm in arms]
    refused = [step for step, arm in asked if step in by_arm.get(arm, ())]
    first = min(refused, default=len(STEPS))
    assert all(play.done_by(arms, step) == {int(step < first)} for step, arms in enumerate(STEPS))
    assert not any(arm.stopped for arm in play.arms.values())
    assert bool(play.agreement.error) == bool(refused)


@given(EVENTS, st.integers(0, len(STEPS) - 1))
@settings(max_examples=40)
def test_arm_that_fails_ends_the_program_and_leaves_no_arm_moving(
    events: Events, step: int
) -> None:
    play = Play(k1607=PlayedArm(fails=frozenset({step})))
    disturb(play, events)
    play.finish()
    assert bool(play.agreement.error) == ("k1607" in STEPS[step])
    assert ("holds nothing" in play.agreement.reason) == ("k1607" in STEPS[step])


@given(STEADY, st.sampled_from(ARMS), st.integers(0, 40))
@settings(max_examples=40)
def test_arm_that_is_launched_again_ends_the_program(events: Events, arm: str, when: int) -> None:
    play = Play()
    disturb(play, events[:when])
    play.arms[arm].launch()
    disturb(play, events[when:])
    play.finish()
    is_done = all(play.done_by(arms, step) == {1} for step, arms in enumerate(STEPS))
    assert is_done or "its rack was launched anew" in play.agreement.reason


@pytest.mark.parametrize(
    ("keeps_s", "error", "attempts"), [(3.0, Error.NONE, 1), (0.5, Error.TOO_LATE, MAX_ATTEMPTS)]
)
def test_expired_promise_is_requested_again(keeps_s: float, error: Error, attempts: int) -> None:
    play = Play(puma=PlayedArm(keeps_s=keeps_s))
    disturb(play, [frozenset(), frozenset(), *[frozenset({"k1607"})] * 8])
    asked = set[int]()
    while play.agreement.phase is not Phase.OVER:
        play.cycle()
        asked.add(play.agreement.attempt)
    assert (play.agreement.error, max(asked)) == (error, attempts)
    assert not any(arm.stopped for arm in play.arms.values())


@pytest.mark.parametrize(
    "said", [[OrderVerb.DO], [OrderVerb.ASK, OrderVerb.DO]], ids=["never", "not yet"]
)
def test_order_that_was_not_promised_fails(said: list[OrderVerb]) -> None:
    taken = TakenOrder(CellReport.zeros({}))
    for what in said:
        taken.process_order(PROGRAM, 3000, what)
    assert (taken.response, taken.error) == (Response.FAILED, Error.GIVEN_UP)
    assert taken.reason == "told to do what it has not promised: its rack was launched anew"
