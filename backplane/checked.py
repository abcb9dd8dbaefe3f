"""Checks of numbers from shared memory, before they are used as enum values or indices.

Every process of the same user can write to the segment, so a number may have any value.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from math import isfinite
from typing import TypeVar

from rack.backplane.errors import DamageError

E = TypeVar("E", bound=IntEnum)
T = TypeVar("T")


def to_enum(kind: type[E], number: float) -> E:
    """Convert a number to a member of an enum.

    Raises:
        DamageError: No member has this value.
    """
    whole = to_integer(number)
    if whole not in set(kind):
        raise DamageError(f"{whole} is not a value of {kind.__name__}")
    return kind(whole)


def to_integer(number: float) -> int:
    """Convert a number to an integer, discarding its fraction.

    Raises:
        DamageError: The number is NaN or infinite.
    """
    if not isfinite(number):
        raise DamageError(f"{number} is not a whole number")
    return int(number)


def select_item(items: Sequence[T], index: int, noun: str) -> T:
    """Return `items[index]` for an index that was read from shared memory.

    Args:
        items: Sequence to select from.
        index: Index read from shared memory.
        noun: Noun for an item in the error message, such as "mailbox".

    Raises:
        DamageError: The index is out of range.
    """
    if not 0 <= index < len(items):
        raise DamageError(f"{index} is not the index of a {noun}; there are {len(items)}")
    return items[index]
