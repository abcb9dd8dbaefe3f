"""Turns on the machine: a wait for one has a bound of its own, and takes nothing of a test's
time."""

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
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-c",
        os.devnull,
        "--rootdir",
        str(tmp_path),
        str(path),
    ]
    command += ["-p", "tests.conftest", "-p", "no:cacheprovider"]
    with taken(tmp_path):
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env={**os.environ, "TMPDIR": str(tmp_path)},
            stdout=subprocess.PIPE,
            text=True,
        )
        # It has come to the gate, and waits there for longer than its test may last.
        wait_until((tmp_path / f"rack-tests-{os.getuid()}-gate").exists)
        time.sleep(1.5 * LIMIT_S)
    output, _ = process.communicate(timeout=BOUND_S)
    assert process.returncode == 0, output
