"""Tests racks seen from another PID namespace with the same shared memory.

A container that shares the IPC namespace of its host sees them in this way.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.segment import list_racks
from tests.processes import RACK
from tests.tools.command_line import BOUND_S, ROOT
from tests.tools.held_racks import held_rack

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


def inside(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a new PID namespace."""
    command = [*INSIDE, *RACK, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=BOUND_S)


@pytest.fixture
def held(rack_name: str, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Launcher of a recorded rack in this namespace, held before tick 0."""
    with held_rack(tmp_path, rack_name, "--out", tmp_path / "run") as (process, _):
        yield process


def seen(name: str) -> dict[str, object]:
    """Return what `rack list` reports about a rack in another PID namespace."""
    rows = json.loads(inside("list", "--json").stdout)
    return next(row for row in rows if row["rack"] == name)


def test_a_running_rack_is_listed_as_running_never_cleaned_and_can_be_stopped(
    held: subprocess.Popen[bytes], rack_name: str, tmp_path: Path
) -> None:
    row = seen(rack_name)
    assert (row["state"], row["launcher"]) == ("running", None)
    assert str(row["detail"]).endswith("s ago by a process of another PID namespace")
    assert rack_name in json.loads(inside("clean", "--json").stdout)["in_use"]
    refused = inside("run", str(tmp_path / "counting.toml"), "--set", f"name={rack_name}")
    assert refused.returncode == 1
    assert "is already running, launched by a process of another PID namespace" in refused.stderr
    # The number of its recorder is that of another process here.
    assert json.loads(inside("status", rack_name, "--json").stdout)["recording"] is None
    assert held.poll() is None
    stopped = inside("stop", rack_name)
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
    assert seen(rack_name)["state"] == "dead"
    assert rack_name in json.loads(inside("clean", "--json").stdout)["removed"]
    assert rack_name not in list_racks()
