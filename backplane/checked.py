"""Checks of numbers in shared memory, by those who turn them into names and records.

Every process of the user may write there, so that a number may be any.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from math import isfinite
from typing import TypeVar

from rack.backplane.errors import DamageError

E = TypeVar("E", bound=IntEnum)
T = TypeVar("T")


def as_named(kind: type[E], number: float) -> E:
    """Return a number as a value of an enum. Raises `DamageError` if it is none."""
    whole = as_whole(number)
    if whole not in set(kind):
        raise DamageError(f"{whole} is not a value of {kind.__name__}")
    return kind(whole)


def as_whole(number: float) -> int:
    """Return a number as an integer. Raises `DamageError` if it is NaN or infinite."""
    if not isfinite(number):
        raise DamageError(f"{number} in place of a whole number")
    return int(number)


def pick(items: Sequence[T], index: int, what: str) -> T:
    """Return the item with an index.

    Args:
        items: The items.
        index: The number in shared memory.
        what: Noun for an item, as in "mailbox".

    Returns:
        The item.

    Raises:
        DamageError: There is no such item.
    """
    if not 0 <= index < len(items):
        raise DamageError(f"{index} is not the number of a {what}; there are {len(items)}")
    return items[index]
