"""The house: imports point downward only, folders and files form no circle, rooms are closed, and
files stay small."""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = ("backplane", "levels", "boards", "tools")
"""From the ground up; each may import itself and those before it."""
ROOMS = (
    ("tools/lab", "", {f"tools/commands/{name}.py" for name in ("bench", "reproduce")}),
    ("levels/systems", "levels", set()),
)
"""A room, the floor whose other files do not import it, and those that do."""
PARTS = {Path("boards/config/rules"): Path("boards/config")}
"""Folders that are parts of others: a config is resolved by rules, and these rest on its tables and
wiring."""
LONGEST_FILE = 600
SOURCES = sorted(path for floor in FLOORS for path in (ROOT / floor).rglob("*.py"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of a file."""
    return tuple(ast.walk(ast.parse(path.read_text())))


def name_of(path: Path) -> str:
    """Return the place of a file in the project."""
    return str(path.relative_to(ROOT))


@cache
def imported(path: Path) -> frozenset[str]:
    """Return the modules that a file imports, at its head or later, by their dotted names."""
    found = nodes(path)
    names = {alias.name for node in found if isinstance(node, ast.Import) for alias in node.names}
    for node in found:
        if isinstance(node, ast.ImportFrom) and node.module:
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name for name in submodules if file_of(name)} or {node.module}
    return frozenset(names)


@cache
def file_of(module: str) -> Path | None:
    """Return the file of one of our own modules."""
    if not module.startswith("rack."):
        return None
    place = ROOT.joinpath(*module.split(".")[1:])
    found = (path for path in (place.with_suffix(".py"), place / "__init__.py") if path.exists())
    return next(found, None)


def packages(path: Path) -> set[str]:
    """Return the top-level packages that a file imports; of our own, the floors."""
    return {".".join(name.split(".")[: 1 + name.startswith("rack.")]) for name in imported(path)}


@pytest.mark.slow
@pytest.mark.parametrize("floor", FLOORS)
def test_imports_point_downward_only(floor: str) -> None:
    above = {f"rack.{name}" for name in FLOORS[FLOORS.index(floor) + 1 :]} | {"tests"}
    upward = {
        f"{name_of(path)} imports {', '.join(sorted(found))}"
        for path in SOURCES
        if path.is_relative_to(ROOT / floor) and (found := packages(path) & above)
    }
    assert not upward


@pytest.mark.slow
def test_folders_form_no_circle() -> None:
    # A folder's __init__ shows what the folder has to offer: it is no part of what the folder's
    # files need.
    needs: defaultdict[Path, set[Path]] = defaultdict(set)
    for path in SOURCES:
        if path.name != "__init__.py":
            found = {folder_of(file) for name in imported(path) if (file := file_of(name))}
            needs[folder_of(path)] |= found - {folder_of(path)}
    refuse_circle(needs)


def test_files_form_no_circle() -> None:
    # Imports for types and inside functions count: a file that needs another to be understood needs
    # it.
    refuse_circle(
        {
            path.relative_to(ROOT): {
                file.relative_to(ROOT) for name in imported(path) if (file := file_of(name))
            }
            for path in SOURCES
        }
    )


def folder_of(file: Path) -> Path:
    folder = file.parent.relative_to(ROOT)
    return PARTS.get(folder, folder)


def refuse_circle(needs: Mapping[Path, set[Path]]) -> None:
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(str(place) for place in reversed(error.args[1])))


@pytest.mark.parametrize(("room", "floor", "guests"), ROOMS)
def test_a_room_is_entered_only_by_its_own_files_and_by_its_commands(
    room: str, floor: str, guests: set[str]
) -> None:
    module = f"rack.{room.replace('/', '.')}"
    outside = [
        path
        for path in SOURCES
        if path.is_relative_to(ROOT / floor) and not path.is_relative_to(ROOT / room)
    ]
    entering = {
        name_of(path)
        for path in outside
        if any(f"{name}.".startswith(f"{module}.") for name in imported(path))
    }
    assert entering == guests


def test_no_file_grows_beyond_what_one_can_read() -> None:
    long = [name_of(path) for path in SOURCES if len(path.read_text().splitlines()) > LONGEST_FILE]
    assert not long


@pytest.mark.slow
def test_json_is_encoded_in_one_file() -> None:
    """Python's own encoder writes NaN, which is no JSON."""
    encoding = {
        name_of(path)
        for path in SOURCES
        for node in nodes(path)
        if (isinstance(node, ast.Attribute) and ast.unparse(node) in ("json.dump", "json.dumps"))
        or (isinstance(node, ast.ImportFrom) and node.module in ("json", "orjson", "simplejson"))
    }
    assert encoding == {"backplane/json_text.py"}


@pytest.mark.slow
def test_no_two_classes_share_a_name() -> None:
    places = defaultdict(list)
    for path in SOURCES:
        for node in nodes(path):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(name_of(path))
    assert not {name: files for name, files in places.items() if len(files) > 1}


def test_bus_and_levels_need_no_tool_of_the_host_side() -> None:
    # A board's process must not carry what only a terminal or a recorder needs.
    host_side = {"pyarrow", "rerun", "rich", "typer"}
    needing = {
        name_of(path)
        for path in SOURCES
        if not path.is_relative_to(ROOT / "tools") and packages(path) & host_side
    }
    assert not needing


def test_the_ground_floor_stands_on_published_packages_alone() -> None:
    allowed = set(sys.stdlib_module_names) | {"rack.backplane", "numpy", "posix_ipc", "xxhash"}
    ground = [path for path in SOURCES if path.is_relative_to(ROOT / "backplane")]
    assert not (set().union(*map(packages, ground)) - allowed)


NOT_QUICK = r"mark\.(slow|thorough|alone)"
"""Marks of tests that `make quick` leaves out."""


@pytest.mark.slow
def test_every_room_has_quick_tests() -> None:
    quick: defaultdict[Path, int] = defaultdict(int)
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        body = ast.parse(path.read_text()).body
        marks = [ast.unparse(node) for node in body if isinstance(node, ast.Assign)]
        tests = [node for node in body if isinstance(node, ast.FunctionDef)]
        marked = [
            " ".join([*marks, *map(ast.unparse, test.decorator_list)])
            for test in tests
            if test.name.startswith("test_")
        ]
        quick[path.parent] += sum(not re.search(NOT_QUICK, found) for found in marked)
    assert not [name_of(folder) for folder, count in quick.items() if not count]


CORE = ("run", "check", "inject", "report")
"""Commands that make up the core, with the processes and the levels of the NASREM rack."""
OUTSIDE = ("tools/viewer", "tools/network", "tools/lab", "levels/systems")


def test_the_core_needs_no_viewer_no_network_no_lab_and_no_other_system() -> None:
    starts = [ROOT / "tools" / "commands" / f"{name}.py" for name in CORE]
    starts += [ROOT / "boards/crate/__main__.py", ROOT / "tools/recording/recorder/__main__.py"]
    starts += [
        path
        for room in ("servo", "primitive", "elemental_move", "task")
        for path in (ROOT / "levels" / room).glob("*.py")
    ]
    core, found = set(starts), list(starts)
    while found:
        needed = {file for name in imported(found.pop()) if (file := file_of(name))} - core
        core |= needed
        found += needed
    assert not [name_of(path) for path in core if name_of(path).startswith(OUTSIDE)]


def test_names_used_of_modules_that_are_loaded_by_name_exist() -> None:
    """Type checkers do not see them."""
    missing = []
    for path in SOURCES:
        constants = {
            node.targets[0].id: node.value.value
            for node in nodes(path)
            if isinstance(node, ast.Assign)
            and isinstance(node.targets[0], ast.Name)
            and isinstance(node.value, ast.Constant)
        }
        loaded = {}
        for node in nodes(path):
            match node:
                case ast.Assign(
                    [ast.Name(name)], ast.Call(ast.Name("import_module"), [ast.Name(c)])
                ):
                    loaded[name] = constants[c]
        for node in nodes(path):
            match node:
                case ast.Attribute(ast.Call(ast.Name("import_module"), [ast.Name(c)]), attribute):
                    module = constants[c]
                case ast.Attribute(ast.Name(name), attribute) if name in loaded:
                    module = loaded[name]
                case _:
                    continue
            if not hasattr(import_module(module), attribute):
                missing.append(f"{name_of(path)}:{node.lineno}: {module} has no '{attribute}'")
    assert not missing
