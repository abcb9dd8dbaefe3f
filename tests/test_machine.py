"""Turns on the machine: a wait for one has a bound of its own, and takes nothing of a test's time.
What judges the machine instead of rack runs again."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests import machine
from tests.processes import BOUND_S, wait_until

ROOT = Path(__file__).resolve().parents[1]
LIMIT_S = 1
SESSION_S = 100.0
TEST = f"""
import pytest

@pytest.mark.timeout({LIMIT_S})
def test_nothing():
    pass
"""


@contextmanager
def taken(folder: Path) -> Iterator[None]:
    """Have the machine, as a test that is alone has it."""
    fd = os.open(folder / f"rack-tests-{os.getuid()}-machine", os.O_CREAT | os.O_RDWR, 0o600)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def session(path: Path) -> subprocess.Popen[str]:
    """Start the tests in a file, as those of the project run, one by one."""
    folder = path.parent
    ours = ["-p", "tests.conftest", "-p", "no:cacheprovider", "-c", os.devnull]
    return subprocess.Popen(
        [sys.executable, "-m", "pytest", "-q", *ours, "--rootdir", str(folder), str(path)],
        cwd=ROOT,
        env={**os.environ, "TMPDIR": str(folder)},
        stdout=subprocess.PIPE,
        text=True,
    )


def test_a_turn_that_does_not_come_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(machine, "_FOLDER", tmp_path)
    monkeypatch.setattr(machine, "WAIT_S", 0.05)
    with (
        taken(tmp_path),
        pytest.raises(TimeoutError, match="no turn on the machine"),
        machine.turn(alone=False),
    ):
        pass
    with machine.turn(alone=True):
        pass


@pytest.mark.slow
def test_waiting_for_a_turn_is_no_part_of_a_tests_time(tmp_path: Path) -> None:
    path = tmp_path / "test_nothing.py"
    path.write_text(TEST)
    with taken(tmp_path):
        process = session(path)
        # It has come to the gate, and waits there for longer than its test may last.
        wait_until((tmp_path / f"rack-tests-{os.getuid()}-gate").exists)
        time.sleep(1.5 * LIMIT_S)
    output, _ = process.communicate(timeout=BOUND_S)
    assert process.returncode == 0, output


FAILING = """
from itertools import count

import pytest

from tests import conftest

steal = {steal}
conftest.stolen = lambda: next(steal)
turns = count(1)

@pytest.mark.alone
def test_that_fails_once():
    assert next(turns) > 1

@pytest.mark.alone
def test_that_fails():
    assert False

def test_beside_others():
    assert False
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steal", "ended"),
    [("count()", {"2 failed", "1 passed", "3 rerun"}), ("iter(int, 1)", {"3 failed"})],
    ids=["held-back", "undisturbed"],
)
def test_what_is_alone_and_fails_runs_again_while_the_hypervisor_holds_cores_back(
    tmp_path: Path, steal: str, ended: set[str]
) -> None:
    path = tmp_path / "test_failing.py"
    path.write_text(FAILING.format(steal=steal))
    output, _ = session(path).communicate(timeout=SESSION_S)
    counted = set(output.splitlines()[-1].partition(" in ")[0].split(", "))
    assert {each for each in counted if "warning" not in each} == ended, output
