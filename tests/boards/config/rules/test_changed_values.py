"""Every value of some shipped configs, changed: what is then said, or wired, is what it was.

Where other tests ask for a message, this one sees that no limit moves, up or down, and that no
value stops to matter.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import pytest

from rack.boards.config import resolve
from rack.boards.config.files import Assembled, assemble
from rack.boards.config.loader import validate
from rack.boards.config.timing import build_rack_timing
from rack.boards.errors import ConfigError
from tests.snapshots import ROOT, Snapshots, digest

pytestmark = pytest.mark.thorough
SNAPSHOTS = Snapshots(__file__)
RACKS = ("nasrem.toml", "cyclic.toml", "brown/one-machine.toml", "cell/puma.toml", "fig4.toml")
SKIPPED = {"name", "python_path", "format", "joints", "task", "mesh", "model", "seed"}
"""Keys whose values are no numbers of the rack's own, or one like many others."""
FIRST = 2
"""Entries of a list that are changed."""


def places(tables: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the place of every number, word and switch."""
    if isinstance(tables, dict):
        for key, value in tables.items():
            if key not in SKIPPED:
                yield from places(value, (*path, key))
    elif isinstance(tables, list):
        for at, value in enumerate(tables[:FIRST]):
            yield from places(value, (*path, at))
    else:
        yield path


def others(value: Any) -> list[Any]:
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [-1, 0, 1, value + 1, 2 * value, 10**6]
    if isinstance(value, float):
        return [-1.0, 0.0, value / 2, value + 1.0, 1e9]
    return ["", "no such thing"] if isinstance(value, str) else []


def outcome(tables: dict[str, Any]) -> str:
    """Return what is said of a config, or a digest of what comes of it."""
    try:
        rack = resolve(validate(Assembled(tables)))
    except ConfigError as error:
        return str(error)
    timing = build_rack_timing(rack.config, rack.layout)
    return digest((rack.layout, rack.tasks, rack.hosts, rack.build_clock_wiring(None), timing))


@pytest.mark.parametrize("name", RACKS)
def test_every_changed_value_has_the_recorded_outcome(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2, 3})
    tables = assemble(ROOT / "configs" / name, (), None).tables
    cases: dict[str, dict[str, object]] = {}
    for path in places(tables):
        changed = deepcopy(tables)
        table: Any = changed
        for key in path[:-1]:
            table = table[key]
        found = []
        for value in others(table[path[-1]]):
            table[path[-1]] = value
            found.append(outcome(deepcopy(changed)))
        case = f"{name}: {'.'.join(map(str, path[:2]))}"
        cases.setdefault(case, {})[".".join(map(str, path))] = found
    SNAPSHOTS.check_all(f"{name}: ", cases)
