"""View of a level's attributes as plain data, to be shown to the user.

The view contains all attributes of the level. If the value of an attribute is an object, it is
shown by those of its own attributes that have changed since the level was built. Functions,
classes, configs and views of shared memory are left out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from enum import Enum
from math import isfinite
from typing import Any

import numpy as np

from rack.backplane.byte_lock import ByteLock
from rack.backplane.layout import Layout
from rack.backplane.message import Message, decode_text
from rack.backplane.segment import Segment
from rack.boards.run.settings import has_attributes, list_attribute_names
from rack.levels.level import Executor, Planner

MAX_ITEMS = 24
"""Maximum number of array elements or items shown. Larger collections are shown as their size."""
MAX_DEPTH = 5
"""Maximum nesting of objects."""
OMITTED_CLASSES = (ByteLock, Layout, Segment)
"""Classes of objects that are never shown."""
_NOTHING = object()


class ObjectAttributes(dict[str, Any]):
    """Attributes of an object by name. A separate type, to distinguish them from a mapping."""


def read_attributes(level: Executor | Planner) -> Mapping[str, Any]:
    """Return the values of a level's attributes, keyed by name, as data that JSON can store.

    Objects are represented by dictionaries of the attributes that have changed. For comparison, a
    level with the same context is built. Call this in a copy of the level's process only: once the
    attributes of an object have been listed, Python needs more time for each access to them.
    """
    now = _AttributeReader().read_attributes(level, MAX_DEPTH)
    built = type(level)(level.context)
    try:
        before = _AttributeReader().read_attributes(built, MAX_DEPTH)
    finally:
        built.close()
    changes = {
        name: _find_changes(value, before.get(name))
        for name, value in now.items()
        if isinstance(value, ObjectAttributes)
    }
    return _omit_missing((now | changes).items())


def _find_changes(now: Any, built: Any) -> Any:
    """Return a value if it has changed or, for an object, the attributes that have changed.

    Args:
        now: Current value as plain data.
        built: Value when the level was built.

    Returns:
        `_NOTHING` if there is no change.
    """
    if not isinstance(now, ObjectAttributes) or not isinstance(built, ObjectAttributes):
        return _NOTHING if now == built else now
    changes = (
        (name, _find_changes(value, built.get(name, _NOTHING))) for name, value in now.items()
    )
    return _omit_missing(changes) or _NOTHING


def _omit_missing(items: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return the items as a dictionary, without those whose value is `_NOTHING`."""
    return {name: value for name, value in items if value is not _NOTHING}


class _AttributeReader:
    """Converts a tree of objects to plain data. Each object is shown only where it occurs first."""

    def __init__(self) -> None:
        self._seen: set[int] = set()

    def read_attributes(self, thing: object, depth: int) -> ObjectAttributes:
        """Return the attributes of an object as plain data.

        Args:
            thing: The object.
            depth: Number of further levels of nested objects to show.
        """
        self._seen.add(id(thing))
        return ObjectAttributes(
            _omit_missing(
                (name, self._to_plain(getattr(thing, name), depth))
                for name in list_attribute_names(thing)
            )
        )

    def _to_plain(self, thing: Any, depth: int) -> Any:
        """Return a value as plain data, or `_NOTHING` if it is not shown."""
        match thing:
            case Enum():
                return thing.name.lower()
            case bytes() | bytearray():
                return thing.hex() if b"\x00" in thing else decode_text(thing)
            case float() if not isfinite(thing):
                # JSON has no representation of these values.
                return str(thing)
            case None | bool() | str() | int() | float():
                return thing
            case Message():
                return self._array_to_plain(thing.record, depth)
            case np.ndarray() | np.generic():
                return self._array_to_plain(thing, depth)
            case Mapping() | list() | deque() | tuple() | set() | frozenset():
                return self._items_to_plain(thing, depth)
        is_omitted = isinstance(thing, OMITTED_CLASSES) or not has_attributes(thing)
        if is_omitted or id(thing) in self._seen or not depth:
            return _NOTHING
        return self.read_attributes(thing, depth - 1) or _NOTHING

    def _array_to_plain(self, array: Any, depth: int) -> Any:
        """Return an array, a numpy number or a record as plain data."""
        if array.size > MAX_ITEMS:
            return f"{' x '.join(map(str, array.shape))} of {array.dtype.name}"
        if array.shape:
            return [self._array_to_plain(row, depth) for row in array]
        if array.dtype.names is None:
            return self._to_plain(array.item(), depth)
        return {name: self._array_to_plain(array[name], depth) for name in array.dtype.names}

    def _items_to_plain(self, thing: Any, depth: int) -> Any:
        """Return a collection as plain data, or its size if it is too large."""
        if len(thing) > MAX_ITEMS:
            return f"{len(thing)} items"
        if isinstance(thing, Mapping):
            return _omit_missing(
                (str(key), self._to_plain(value, depth)) for key, value in thing.items()
            )
        plain = [self._to_plain(item, depth) for item in thing]
        return [
            f"a {type(item).__name__}" if shown is _NOTHING else shown
            for item, shown in zip(thing, plain, strict=True)
        ]
