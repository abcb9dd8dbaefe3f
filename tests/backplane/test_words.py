"""Words that switch at a tick: all readers agree by ticks alone."""

from __future__ import annotations

from rack.backplane.words import encode_switch, is_switched_on


def test_a_word_switches_at_its_tick_and_one_never_switched_is_off() -> None:
    assert not any(is_switched_on(0, tick) for tick in (0, 1, 10**9))
    on, off = encode_switch(8, True), encode_switch(24, False)
    assert [is_switched_on(on, tick) for tick in (0, 7, 8, 100)] == [False, False, True, True]
    assert [is_switched_on(off, tick) for tick in (8, 23, 24, 100)] == [True, True, False, False]
