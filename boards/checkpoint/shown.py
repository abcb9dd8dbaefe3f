"""The attributes of a level as plain data, for people: its own, and of the objects in them what has
changed since the level was built. Programs, configs and views of shared memory are left out."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from enum import Enum
from math import isfinite
from typing import Any

import numpy as np

from rack.backplane.message import Message, text_of
from rack.boards.checkpoint.kinds import part_kind
from rack.boards.checkpoint.parts import Parts
from rack.boards.errors import CheckpointError

MOST = 24
"""Numbers of an array, or items, that are shown; of larger ones the size."""
DEPTH = 5
"""Objects within objects, at most."""
_OMITTED = object()


class Attributes:
    """Shows objects of one process, each at the first place that leads to it."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._changed = parts.changed()
        self._shown: set[int] = set()

    def of(self, level: object) -> dict[str, Any]:
        """Return the attributes of a level by name, as JSON holds them: numbers, texts, lists, and
        objects as dictionaries of theirs."""
        attributes = part_kind(type(level)).inner(level)
        self._shown.add(id(level))
        return _whole({str(name): self._plain(value, DEPTH) for name, value in attributes})

    def _plain(self, thing: Any, depth: int) -> Any:
        match thing:
            case Enum():
                return thing.name.lower()
            case bytes() | bytearray():
                return thing.hex() if b"\x00" in thing else text_of(thing)
            case float() if not isfinite(thing):
                # JSON has no word for it.
                return str(thing)
            case None | bool() | str() | int() | float():
                return thing
            case Message():
                return self._array(thing.record, depth)
            case np.ndarray() | np.generic():
                return self._array(thing, depth)
            case Mapping() | list() | deque() | tuple() | set() | frozenset():
                return self._items(thing, depth)
        return self._object(thing, depth)

    def _array(self, array: Any, depth: int) -> Any:
        """Return an array, a number of numpy, or a record."""
        if array.size > MOST:
            sizes = " x ".join(map(str, array.shape))
            return f"{sizes} of {array.dtype.name}"
        if array.shape:
            return [self._array(row, depth) for row in array]
        if array.dtype.names is None:
            return self._plain(array.item(), depth)
        return {name: self._array(array[name], depth) for name in array.dtype.names}

    def _items(self, thing: Any, depth: int) -> Any:
        if len(thing) > MOST:
            return f"{len(thing)} items"
        if isinstance(thing, Mapping):
            return _whole({str(key): self._plain(value, depth) for key, value in thing.items()})
        found = [self._plain(item, depth) for item in thing]
        return [
            f"a {type(item).__name__}" if plain is _OMITTED else plain
            for item, plain in zip(thing, found, strict=True)
        ]

    def _object(self, thing: object, depth: int) -> Any:
        """Return what is news in an object within others."""
        try:
            kind = part_kind(type(thing))
        except CheckpointError:
            return _OMITTED
        if kind.name != "object" or id(thing) in self._shown or not depth:
            return _OMITTED
        self._shown.add(id(thing))
        number = self._parts.number(thing)
        changed, _ = self._changed.get(number, ({}, []))
        found = {
            str(name): self._plain(value, depth - 1)
            for name, value in kind.inner(thing)
            if number < 0 or name in changed or self._may_be_news(value)
        }
        return _whole(found) or _OMITTED

    def _may_be_news(self, value: object) -> bool:
        """Say whether an attribute that has not been set since may have changed within."""
        number = self._parts.number(value)
        return number in self._changed or (number >= 0 and part_kind(type(value)).name == "object")


def _whole(found: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in found.items() if value is not _OMITTED}
