"""Tests racks seen from another PID namespace with the same shared memory.

A container that shares the IPC namespace of its host sees them in this way.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from rack.backplane.segment import list_racks
from tests.tools.command_line import BOUND_S, ROOT
from tests.tools.held_racks import held_rack

COMMANDS = """
import json, sys
from tests.tools.command_line import rack
print(json.dumps([vars(rack(*words)) for words in json.loads(sys.argv[1])]))
"""
INSIDE = ("unshare", "--pid", "--fork", "--kill-child", "--mount-proc")


def why_not() -> str:
    """Return why this machine cannot create PID namespaces, or an empty text."""
    if shutil.which(INSIDE[0]) is None:
        return "no unshare (util-linux)"
    return subprocess.run([*INSIDE, "true"], capture_output=True, text=True).stderr


pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(why_not()), reason=f"needs PID namespaces: {why_not()}"),
]


def inside(*commands: tuple[str, ...]) -> list[SimpleNamespace]:
    """Run commands in a new PID namespace, one after the other in one process."""
    line = [*INSIDE, sys.executable, "-c", COMMANDS, json.dumps(commands)]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=BOUND_S)
    return [SimpleNamespace(**found) for found in json.loads(done.stdout)]


@pytest.fixture
def held(rack_name: str, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Launcher of a recorded rack in this namespace, held before tick 0."""
    with held_rack(tmp_path, rack_name, "--out", tmp_path / "run") as (process, _):
        yield process


LIST = ("list", "--json")
CLEAN = ("clean", "--json")


def find_row(listed: SimpleNamespace, name: str) -> dict[str, object]:
    """Return what `rack list` reports about a rack."""
    return next(row for row in json.loads(listed.stdout) if row["rack"] == name)


@pytest.mark.thorough
def test_a_running_rack_is_listed_as_running_never_cleaned_and_can_be_stopped(
    held: subprocess.Popen[bytes], rack_name: str, tmp_path: Path
) -> None:
    listed, cleaned, refused, status, stopped = inside(
        LIST,
        CLEAN,
        ("run", str(tmp_path / "counting.toml"), "--set", f"name={rack_name}"),
        ("status", rack_name, "--json"),
        ("stop", rack_name),
    )
    row = find_row(listed, rack_name)
    assert (row["state"], row["launcher"]) == ("running", None)
    assert str(row["detail"]).endswith("s ago by a process of another PID namespace")
    assert rack_name in json.loads(cleaned.stdout)["in_use"]
    assert refused.returncode == 1
    assert "is already running, launched by a process of another PID namespace" in refused.stderr
    # The number of its recorder is that of another process here.
    assert json.loads(status.stdout)["recording"] is None
    # It ran until it was stopped.
    assert (stopped.returncode, stopped.stdout) == (0, f"rack '{rack_name}' has ended\n")
    assert rack_name not in list_racks()
    assert held.wait(BOUND_S) == 1


# Other tests clean up every dead rack that they find.
@pytest.mark.alone
def test_a_rack_whose_launcher_was_killed_is_listed_as_dead_and_cleaned(
    held: subprocess.Popen[bytes], rack_name: str
) -> None:
    os.kill(held.pid, signal.SIGKILL)
    held.wait(BOUND_S)
    listed, cleaned = inside(LIST, CLEAN)
    assert find_row(listed, rack_name)["state"] == "dead"
    assert rack_name in json.loads(cleaned.stdout)["removed"]
    assert rack_name not in list_racks()
