"""A rack that steps with this one: what has come of it, and whether it is still awaited."""

from __future__ import annotations

from rack.boards.lan.awaited import Why, word_of
from rack.boards.lan.lockstep import NEVER, Partner, Step, StepFlag
from rack.boards.lan.peers import NONE


def step(time_ns: int, flags: int = 0) -> Step:
    """Return a step of that time."""
    return Step(launch=7, time_ns=time_ns, flags=flags, cycle_ns=8, racks=("a",), exports=())


def test_steps_are_passed_on_once_and_up_to_a_time() -> None:
    partner = Partner("b", 3)
    for time_ns in (8, 16, 16, 8, 24):
        partner.take(step(time_ns))
    assert [passed.time_ns for passed in partner.passed(16)] == [8, 16]
    assert [passed.time_ns for passed in partner.passed(16)] == []
    assert [partner.has_reached(time_ns) for time_ns in (24, 25)] == [True, False]
    assert [passed.time_ns for passed in partner.passed(100)] == [24]


def test_a_rack_that_is_over_is_awaited_no_more_until_it_sends_again() -> None:
    partner = Partner("b", 3)
    partner.gone_s = 1.0
    partner.take(step(8, StepFlag.OVER))
    assert (partner.has_reached(1000), partner.gone_s) == (True, None)
    partner.take(step(16))
    assert not partner.has_reached(1000)


def test_the_word_says_why_it_is_awaited() -> None:
    partner = Partner("b", 3)
    assert partner.word == word_of(3, Why.UNSEEN)
    partner.launch = 7
    assert partner.word == word_of(3, Why.SLOWER)
    partner.gone_s = 1.0
    assert partner.word == word_of(3, Why.GONE)


def test_a_rack_that_is_forgotten_is_awaited_as_at_first() -> None:
    partner = Partner("b", 3)
    partner.launch = 7
    partner.gone_s = 1.0
    partner.is_there = True
    partner.take(step(8, StepFlag.OVER))
    partner.forget()
    assert (partner.launch, partner.time_ns, partner.gone_s) == (NONE, NEVER, None)
    assert not partner.steps
    assert [partner.is_out, partner.is_there, partner.has_reached(0)] == [False] * 3
