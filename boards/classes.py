"""Classes of levels by name, as in "package.module:Class"."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


def extend_path(folders: Sequence[Path]) -> None:
    """Append folders to Python's import path."""
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]


def find_class(reference: str, base: type[T]) -> type[T]:
    """Return the subclass of `base` that "package.module:Class" names. Raises `LookupError` with the reason."""
    module_name, _, name = reference.partition(":")
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a user's module may raise anything while it is imported
        raise LookupError(f"cannot import '{module_name}': {type(error).__name__}: {error}") from error
    found = getattr(module, name, None)
    if not isinstance(found, type) or not issubclass(found, base):
        kinds = [n for n, c in inspect.getmembers(module, inspect.isclass) if issubclass(c, base) and c is not base]
        what = "has no class" if found is None else f"has no {base.__name__} named"
        raise LookupError(f"module '{module_name}' {what} '{name}'; it has: {', '.join(kinds) or 'none'}")
    if inspect.isabstract(found):
        missing = ", ".join(sorted(getattr(found, "__abstractmethods__", ())))
        raise LookupError(f"class '{name}' lacks the method '{missing}'")
    return found
