"""Change of settings for a level that continues from a snapshot with its state.

Two levels of the same class are built, one with the old settings and one with the new ones. The
attributes in which these two differ get their new values in the live level, unless the live level
has changed them itself since it was built.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType
from typing import Any

import numpy as np
from pydantic import BaseModel

from rack.levels.level import Executor, LevelContext, Planner

_WHOLE = (BaseModel, LevelContext, ModuleType, memoryview, type)
"""Classes of objects whose attributes are never changed one by one."""
_NUMBERS = "biufc"
"""Kinds of numpy arrays whose elements are compared one by one."""


def change_settings(level: Executor | Planner, context: LevelContext) -> None:
    """Change the settings of a live level to the settings of another context.

    Exceptions of the level's constructor are passed on.

    Args:
        level: The live level.
        context: Context with the new settings.
    """
    before, after = type(level)(level.context), type(level)(context)
    try:
        _SettingsChange().apply_to(level, before, after)
    finally:
        before.close()
        after.close()
    level.context = context


class _SettingsChange:
    """Applies the differences between two objects to a third object of the same class."""

    def __init__(self) -> None:
        self._seen: set[int] = set()

    def apply_to(self, live: object, before: object, after: object) -> None:
        """Apply the differences between `before` and `after` to the attributes of `live`.

        Attributes that `live` has changed itself are not touched.

        Args:
            live: Object to change.
            before: Object built with the old settings.
            after: Object built with the new settings.
        """
        if id(live) in self._seen:
            return
        self._seen.add(id(live))
        for name in list_attribute_names(before):
            if hasattr(live, name) and hasattr(after, name):
                now = getattr(live, name)
                changed = self._merge_values(now, getattr(before, name), getattr(after, name))
                if changed is not now:
                    # This works for frozen dataclasses, too.
                    object.__setattr__(live, name, changed)

    def _merge_values(self, now: Any, old: Any, new: Any) -> Any:
        """Return the new value of an attribute of the live object.

        It is `new` if the settings change the attribute and the live object has not changed it,
        otherwise `now`. Objects and collections are changed in place.

        Args:
            now: Current value in the live object.
            old: Value with the old settings.
            new: Value with the new settings.
        """
        if not type(now) is type(old) is type(new):
            # For example, None has become an object.
            return new if type(now) is type(old) and now == old else now
        match now:
            case np.ndarray():
                if now.shape == old.shape == new.shape and now.dtype.kind in _NUMBERS:
                    changes = (old != new) & (now == old)
                    if changes.any():
                        now[changes] = new[changes]
            case dict() | list() if len(now) == len(old) == len(new):
                for key in now if isinstance(now, dict) else range(len(now)):
                    if isinstance(now, list) or (key in old and key in new):
                        now[key] = self._merge_values(now[key], old[key], new[key])
            case None | bool() | int() | float() | complex() | str() | bytes() | BaseModel():
                return new if old != new and now == old else now
            case _ if has_attributes(now):
                self.apply_to(now, old, new)
        return now


def has_attributes(thing: object) -> bool:
    """Check whether the attributes of an object can be read or changed one by one.

    This excludes functions, classes, configs, and objects without Python attributes.
    """
    is_whole = callable(thing) or isinstance(thing, _WHOLE)
    return not is_whole and (hasattr(thing, "__dict__") or hasattr(type(thing), "__slots__"))


def list_attribute_names(thing: object) -> Iterable[str]:
    """Return the names of an object's attributes, including slots."""
    slots = [getattr(kind, "__slots__", ()) for kind in type(thing).__mro__]
    names = [name for slot_names in slots for name in slot_names if hasattr(thing, name)]
    return [*getattr(thing, "__dict__", ()), *names]
