"""Classes of levels by name, as in "package.module:Class"."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from rack.levels.references import module_and_name

T = TypeVar("T")


def extend_path(folders: Sequence[Path]) -> None:
    """Append folders to Python's import path."""
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]


def find_class(reference: str, base: type[T], is_tried: bool = True) -> type[T]:
    """Return the subclass of `base` that "package.module:Class" names. Raises `LookupError` with
    the reason. `is_tried` is that of `module_and_name`."""
    module, name = module_and_name(reference, is_tried)
    found = getattr(module, name, None)
    if not isinstance(found, type) or not issubclass(found, base):
        kinds = [
            n
            for n, c in inspect.getmembers(module, inspect.isclass)
            if issubclass(c, base) and c is not base
        ]
        what = "has no class" if found is None else f"has no {base.__name__} named"
        raise LookupError(
            f"module '{module.__name__}' {what} '{name}'; it has: {', '.join(kinds) or 'none'}"
        )
    if inspect.isabstract(found):
        missing = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
        raise LookupError(f"class '{name}' lacks the method '{missing}'")
    return found
