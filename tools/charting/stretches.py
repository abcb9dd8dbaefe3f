"""Stretches of time, ns: what is left of one when others are taken out of it."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence

Stretch = tuple[int, int]
"""Start and end, ns."""


def without(stretch: Stretch, busy: Sequence[Stretch]) -> Iterator[Stretch]:
    """Yield what is left of a stretch; `busy` is a `union`."""
    start, end = stretch
    for at in range(bisect_right(busy, start, key=lambda taken: taken[1]), len(busy)):
        if busy[at][0] >= end:
            break
        if busy[at][0] > start:
            yield start, busy[at][0]
        start = busy[at][1]
    if start < end:
        yield start, end


def union(stretches: Iterable[Stretch]) -> list[Stretch]:
    """Return the time that any of the stretches covers, in order, without overlaps."""
    found: list[Stretch] = []
    for start, end in sorted(stretches):
        if found and start <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], end)
        else:
            found.append((start, end))
    return found
