"""The house: imports point downward only, and files stay small."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = ("backplane", "levels", "boards", "tools")
"""From the ground up; each may import itself and those before it."""
LONGEST_FILE = 400
SOURCES = sorted(path for floor in FLOORS for path in (ROOT / floor).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Return the top-level packages that a file imports, at its head or later."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom) and node.level == 0}
    return {name.partition(".")[0] for name in names}


@pytest.mark.parametrize("floor", FLOORS)
def test_imports_point_downward_only(floor: str) -> None:
    above = set(FLOORS[FLOORS.index(floor) + 1 :]) | {"tests"}
    upward = {
        f"{path.relative_to(ROOT)} imports {', '.join(sorted(found))}"
        for path in SOURCES
        if path.is_relative_to(ROOT / floor) and (found := imported(path) & above)
    }
    assert not upward


def test_no_import_is_relative() -> None:
    relative = {
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.level
    }
    assert not relative


def test_no_file_grows_beyond_what_one_can_read() -> None:
    long = {str(path.relative_to(ROOT)) for path in SOURCES if len(path.read_text().splitlines()) > LONGEST_FILE}
    assert not long


def test_bus_and_levels_need_no_tool_of_the_host_side() -> None:
    # A board's process must not carry what only a terminal or a recorder needs.
    host_side = {"pyarrow", "rerun", "rich", "typer"}
    needing = {
        str(p.relative_to(ROOT)) for p in SOURCES if p.parts[len(ROOT.parts)] != "tools" and imported(p) & host_side
    }
    assert not needing


def test_the_ground_floor_stands_on_published_packages_alone() -> None:
    allowed = set(sys.stdlib_module_names) | {"backplane", "numpy", "posix_ipc"}
    other = {name for path in SOURCES if path.is_relative_to(ROOT / "backplane") for name in imported(path)} - allowed
    assert not other
