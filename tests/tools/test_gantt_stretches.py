"""Stretches of time, cut out of each other."""

from __future__ import annotations

import random

from rack.tools.charting.stretches import union, without


def test_a_union_is_in_order_and_has_no_overlaps() -> None:
    assert union([(5, 8), (0, 2), (7, 9), (2, 3), (20, 21), (5, 6)]) == [(0, 3), (5, 9), (20, 21)]


def test_what_is_left_of_a_stretch_lies_between_what_was_taken() -> None:
    assert list(without((0, 10), [])) == [(0, 10)]
    assert list(without((0, 10), [(2, 3), (5, 7)])) == [(0, 2), (3, 5), (7, 10)]
    assert list(without((2, 6), [(0, 3), (5, 9)])) == [(3, 5)]
    assert list(without((2, 6), [(0, 2), (6, 9)])) == [(2, 6)]
    assert list(without((2, 6), [(1, 7)])) == []


def test_every_moment_is_either_taken_or_left() -> None:
    chance = random.Random(5)
    for _ in range(200):
        taken = union((a, a + chance.randint(1, 9)) for a in (chance.randint(0, 60) for _ in range(5)))
        left = list(without((10, 50), taken))
        moments = sorted(at for start, end in [*taken, *left] for at in range(start, end) if 10 <= at < 50)
        assert moments == list(range(10, 50))
