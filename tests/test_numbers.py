"""The numbers on which a room is built: its constants, and the defaults of its functions and
records. None changes unseen."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from types import ModuleType
from typing import Any

import pytest

from rack.backplane.message_type import MessageType
from tests.snapshots import Snapshots, digest

KINDS = (bool, int, float, str, tuple, frozenset, dict, MessageType)


SNAPSHOTS = Snapshots(__file__)
ROOMS = (
    "backplane",
    "backplane/clock",
    "backplane/mailbox",
    "backplane/watch",
    "boards",
    "boards/config",
    "boards/config/rules",
    "boards/crate",
    "boards/faults",
    "boards/host",
    "boards/lan",
    "boards/run",
    "levels/systems/state_table",
    "boards/timing",
    "tools/faults",
    "tools/faults/campaigns",
)


@pytest.mark.parametrize("room", ROOMS)
def test_no_number_changes_unseen(room: str) -> None:
    name = ".".join(("rack", *room.split("/")))
    package = importlib.import_module(name)
    found = {}
    for info in pkgutil.iter_modules(package.__path__, f"{name}."):
        if not info.ispkg and not info.name.endswith("__main__"):
            numbers = dict(_numbers(importlib.import_module(info.name)))
            if numbers:
                found[f"{room}: {info.name.rsplit('.', 1)[1]}"] = {"numbers": numbers}
    SNAPSHOTS.check_all(f"{room}: ", found)


def _numbers(module: ModuleType) -> Iterator[tuple[str, Any]]:
    """Yield the numbers of a module by name."""
    for name, value in sorted(vars(module).items()):
        if name.startswith("__"):
            continue
        # A private table may be one that a process fills, a time to wait one that a test shortens.
        is_changed = (isinstance(value, dict) and name.startswith("_")) or name.endswith("_S")
        if name.isupper() and isinstance(value, KINDS) and not is_changed and _is_plain(value):
            yield name, value
        elif getattr(value, "__module__", "") == module.__name__:
            yield from _defaults(name, value)


def _defaults(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the defaults of a function, or those in a class."""
    if inspect.isfunction(value):
        for parameter in inspect.signature(value).parameters.values():
            if isinstance(parameter.default, KINDS) and _is_plain(parameter.default):
                yield f"{name}({parameter.name})", parameter.default
    elif inspect.isclass(value):
        yield from _of_class(name, value)


def _of_class(name: str, value: type) -> Iterator[tuple[str, Any]]:
    """Yield the defaults of a class's fields and methods, and what it declares."""
    if is_dataclass(value):
        for field in fields(value):
            if field.default is not MISSING and _is_plain(field.default):
                yield f"{name}.{field.name}", field.default
    for key, entry in sorted(vars(value).items()):
        if inspect.isfunction(entry):
            yield from _defaults(f"{name}.{key}", inspect.unwrap(entry))
        elif not key.startswith("_") and isinstance(entry, KINDS) and _is_plain(entry):
            yield f"{name}.{key}", entry


def _is_plain(value: object) -> bool:
    try:
        digest(value)
    except TypeError:
        return False
    return True
