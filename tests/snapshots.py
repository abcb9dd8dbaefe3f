"""What the product derives from the shipped configs, as a digest of each case.

A snapshot says that something changed, not what is right: other tests say that. It stands in a TOML
file beside its test. `make golden` writes all anew, and git shows which cases changed.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache, cached_property
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

ROOT = Path(__file__).parents[1]
SHIPPED = tuple(
    str(path.relative_to(ROOT / "configs"))
    for path in sorted((ROOT / "configs").rglob("*.toml"))
    if re.search(r"^(format|name) = ", path.read_text(), re.MULTILINE)
    and "[[row]]" not in path.read_text()
)
"""The shipped configs that are whole racks."""
QUICK = (
    "brown/brown.toml",
    "brown/servo.toml",
    "cell/cell.toml",
    "chimera/chimera.toml",
    "condor/condor.toml",
    "course/1-overload/overload.toml",
    "ibm/ibm.toml",
    "nasrem.toml",
    "nist-state-table/nist-state-table.toml",
    "penn/penn.toml",
)
"""Those that `make quick` looks at: the others take longer, or are much like one of these."""
each_shipped_rack = pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in SHIPPED],
)
HEAD = "# Made by `make golden`, see tests/snapshots.py."
WRITES = "WRITE_SNAPSHOTS"
"""Set in the environment, it makes `Snapshots.check` write."""


class Snapshots:
    """The snapshots of a test's file: one digest for each case."""

    def __init__(self, test: str) -> None:
        self._path = Path(test).with_suffix(".toml")

    def check(self, case: str, parts: Mapping[str, object]) -> None:
        """Compare the parts of a case with what the file says of them."""
        found = {part: digest(value) for part, value in parts.items()}
        known = self.known
        if WRITES in os.environ:
            known[case] = digest(found)
            entries = [f"{json.dumps(one)} = {json.dumps(known[one])}" for one in sorted(known)]
            self._path.write_text("\n".join((HEAD, "", *entries, "")))
        is_same = known.get(case) == digest(found)
        assert is_same, f"{case}: other than before; meant? make golden; its parts: {found}"

    def check_all(self, group: str, cases: Mapping[str, Mapping[str, object]]) -> None:
        """Check all cases that begin with `group`: those of the file are these and no others."""
        known = {case for case in self.known if case.startswith(group)}
        if WRITES in os.environ:
            for case in known - cases.keys():
                del self.known[case]
        else:
            assert known == cases.keys()
        for case, parts in cases.items():
            self.check(case, parts)

    @cached_property
    def known(self) -> dict[str, str]:
        """What the file says: digests by case."""
        return tomllib.loads(self._path.read_text()) if self._path.exists() else {}


def digest(value: object) -> str:
    """Return a digest of a value: of the plain data in it, without this machine's paths."""
    text = json.dumps(plain(value)).replace(str(ROOT), "")
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@cache
def shown(kind: type) -> list[str]:
    """Return the fields of a dataclass but those that it does not show: they belong to one run."""
    return [field.name for field in fields(kind) if field.repr]


def plain(value: Any) -> Any:  # noqa: C901  # one match of all kinds
    """Return a value as JSON may hold it."""
    # First, as most values are one of these; their subclasses (IntEnum, np.float64) are not.
    if type(value) in (int, float, str, bool, NoneType):
        return value
    match value:
        case Enum():
            return value.name
        case BaseModel():
            return plain(dict(value))
        case _ if is_dataclass(value) and not isinstance(value, type):
            return {name: plain(getattr(value, name)) for name in shown(type(value))}
        case Mapping():
            return {str(key): plain(entry) for key, entry in value.items()}
        case np.ndarray() | np.generic():
            return value.tolist()
        case set() | frozenset():
            return sorted(map(str, value))
        case tuple() | list():
            return [plain(entry) for entry in value]
        case int() | float() | str():
            return value
        case Path():
            return str(value)
        case type():
            return f"{value.__module__}.{value.__qualname__}"
        case bytes():
            return value.hex()
    raise TypeError(f"{type(value)} is no plain data")
