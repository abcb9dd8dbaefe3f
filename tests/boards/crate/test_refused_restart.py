"""A board that dies while the system permits its user no further process."""

from __future__ import annotations

import os
import re
import signal
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import System
from tests.boards.conftest import PLAIN, MakeConfig
from tests.boards.crate.test_rack import as_root, as_user
from tests.processes import FORKS, RACK, exit_status, forked, named, run_to_end, wait_until
from tests.snapshots import ROOT

BOUND_S = 60.0
FIVE_MAY = 65_524
"""A user who may have five processes."""


@pytest.mark.thorough
@pytest.mark.slow
@as_root
@pytest.mark.filterwarnings(FORKS)
def test_a_restart_that_the_system_refuses_is_reported_and_ends_the_run_properly(
    config: MakeConfig, tmp_path: Path, rack_name: str
) -> None:
    path, out = tmp_path / "limited.toml", tmp_path / "out"
    path.write_text(config("clock.mode=realtime", text=PLAIN).to_toml_text())
    limits = ("prlimit", "--nproc=5", *as_user(FIVE_MAY))

    def run_long() -> None:
        command = [*limits, *RACK, "run", str(path), "--seconds", "60", "--no-record", "--share"]
        done = run_to_end(command, BOUND_S, cwd=ROOT)
        out.write_text(f"{done.returncode} {done.stderr}")

    def occupy() -> None:
        os.setuid(FIVE_MAY)
        time.sleep(BOUND_S)

    def is_full() -> bool:
        assert not out.exists(), out.read_text()
        return processes_of(FIVE_MAY) >= 8

    with ExitStack() as stack:
        runner = stack.enter_context(forked(run_long))
        # A whole command: on a loaded machine its imports alone may take half a minute.
        wait_until(lambda: rack_name in list_racks(), BOUND_S)
        segment = Segment.attach(rack_name)
        stack.callback(segment.close)
        # Before the clock runs, a board that cannot be forked is a launch that fails.
        wait_until(lambda: segment.words[System.TICK] > 0, BOUND_S)
        # More than the board that dies leaves room for.
        for _ in range(3):
            stack.enter_context(forked(occupy))
        wait_until(is_full)
        os.kill(named(f"{rack_name}:wave")[0], signal.SIGKILL)
        assert exit_status(runner, BOUND_S) == 0
    assert out.read_text().startswith("1 ")
    # The kernel keeps only the first letters of either name.
    assert re.search(
        "printed: board '(wave|watch)' cannot be forked: Resource temp", out.read_text()
    )


def processes_of(uid: int) -> int:
    """Return how many processes a user has."""
    count = 0
    for status in Path("/proc").glob("[0-9]*/status"):
        with suppress(OSError):
            count += f"\nUid:\t{uid}\t" in status.read_text()
    return count
