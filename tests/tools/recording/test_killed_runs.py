"""SIGKILL of a run's recorder, of its launcher, or of all its processes, at any instant.

At most one second of rows is lost, and every table can be opened.
"""

from __future__ import annotations

import os
import random
import select
import signal
import subprocess
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import NamedTuple

import pytest
from rerun.chunk import RrdReader

from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import Run, System
from rack.boards.config.toml import to_toml
from rack.tools.console.interrupt import list_descendants
from rack.tools.recording.recording import Recording
from rack.tools.viewer.parts import FILE, list_parts
from tests.conftest import SMALL
from tests.machine import run_undisturbed
from tests.processes import RACK, wait_until
from tests.warm import Popen, run_command

pytestmark = [
    pytest.mark.alone,
    pytest.mark.thorough,
    # A viewer's file that was cut off is read to its last whole block.
    pytest.mark.filterwarnings("ignore:RRD file has no footer"),
]

FLIGHT = to_toml({"record": {"keep": "2 s", "before": "0.5 s", "after": "0.5 s"}})
TICKS_A_SECOND = 400
RUN_S = 4.0
LATEST_S = 2.5
"""Instants of the kill, simulated time."""
BOUND_S = 60.0
IN_TIME = 80
"""Ticks by which a recorder that has its share of the machine is behind at most: 0.2 s."""


class Killed(NamedTuple):
    """A run that was killed, in ticks of its fastest task.

    `lost` are the rows written by that instant that are not in the files. `behind` says how far the
    recorder was behind the clock then.
    """

    lost: int
    behind: int


def kill_run(folder: Path, name: str, victim: str, seed: int, record: str = "") -> Killed:
    """Run the small rack in real time, kill at a random instant, and open all tables.

    `record` is a table of its config.
    """
    folder.mkdir(exist_ok=True)
    (folder / "small.toml").write_text(SMALL + record)
    settings = ["--set", f"name={name}", "--set", "clock.mode=realtime"]
    command = [*RACK, "run", folder / "small.toml", *settings, "--seconds", str(RUN_S)]
    run = folder / "run"
    process = Popen([*command, "--out", run, "--json"], stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: name in list_racks(), BOUND_S)
        segment = Segment.attach(name)
        wait_until(lambda: segment.words[System.STATE] == Run.RUNNING, BOUND_S)
        wait_until(lambda: segment.words[System.FOLLOWER_TICK], BOUND_S)
        recorder = segment.words[System.FOLLOWER_PID]
        gone = os.pidfd_open(recorder)
        at = segment.words[System.TICK] + random.Random(seed).uniform(0, LATEST_S) * TICKS_A_SECOND
        # If the recorder started late, the run may end before the kill.
        at = min(at, RUN_S * TICKS_A_SECOND - 1)
        wait_until(lambda: segment.words[System.TICK] >= at, BOUND_S)
        struck = {
            "recorder": [recorder],
            "launcher": [process.pid],
            "all": [process.pid, *list_descendants(process.pid)],
        }
        tick = segment.words[System.TICK]
        behind = tick - segment.words[System.FOLLOWER_TICK]
        for pid in struck[victim]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait(BOUND_S)
        # A process with several threads may still hold its files when it is reported dead.
        ended = select.poll()
        ended.register(gone, select.POLLIN)
        assert ended.poll(BOUND_S * 1e3)
        os.close(gone)
    finally:
        process.kill()
        process.wait()
        assert run_command([*RACK, "clean"], BOUND_S).returncode == 0
    recording = Recording(run)
    assert recording.events
    for mailbox in recording.mailboxes:
        recording.read_rows(mailbox)
    for part in list_parts(run / FILE):
        try:
            RrdReader(str(part)).stream().to_chunks()
        except ValueError as error:
            # The recorder was killed before it wrote its first block.
            if "No recording store found" not in str(error):
                raise
    newest = int(recording.read_trace("lower")["tick"][-1])
    lost = recording.lost_rows.get("lower", 0) + max(0, tick - 1 - newest)
    return Killed(lost, behind)


@pytest.mark.parametrize(
    ("victim", "record"),
    [("recorder", ""), ("launcher", ""), ("all", ""), ("all", FLIGHT)],
    ids=["recorder", "launcher", "all", "all, flight"],
)
def test_a_kill_costs_at_most_a_second_and_every_table_opens(
    tmp_path: Path, rack_name: str, victim: str, record: str
) -> None:
    folders = (tmp_path / str(number) for number in count())

    def find_disturbance(run: Killed) -> str:
        return "" if run.behind <= IN_TIME else f"{run.behind} ticks unread"

    run = run_undisturbed(
        lambda: kill_run(next(folders), rack_name, victim, seed=2, record=record), find_disturbance
    )
    assert run.lost <= TICKS_A_SECOND
