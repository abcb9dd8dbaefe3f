"""A small rack without an arm, as TOML text and as files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest

from tests.machine import turn

SMALL = f"""
name = "small"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 2.5
mode = "lockstep"

[board.upper]
slot = 2
rate_hz = 50
below = "lower"
executor = "two_levels:Upper"
ends_run = true

[board.lower]
slot = 3
rate_hz = 400
above = "upper"
executor = "two_levels:Lower"
planner = "two_levels:LowerPlanner"
coupling = "tight"
within_cycles = 4
"""


_NUMBERS = count()


@pytest.fixture(autouse=True)
def _turn(request: pytest.FixtureRequest) -> Iterator[None]:
    """Take turns with tests that need the machine to themselves."""
    with turn(alone=request.node.get_closest_marker("alone") is not None):
        yield


@pytest.fixture(scope="module")
def machine_alone() -> Iterator[None]:
    """Have the machine for a module: for fixtures that its tests share."""
    with turn(alone=True):
        yield


@pytest.fixture
def rack_name() -> str:
    """A name for a rack that no other test, of this run or another, uses at the same time."""
    return f"test-{os.getpid()}-{next(_NUMBERS)}"


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A rack of two levels that count, as a file."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    """Write a file beside the small rack's."""

    def write_file(name: str, text: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return write_file
