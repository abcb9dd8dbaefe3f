"""Tests SIGINT, SIGTERM and SIGHUP at any moment of a run: exit status, and nothing left behind."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rack.backplane.segment import SHM_FOLDER
from tests.processes import BOUND_S, RACK, children_of, named, wait_until
from tests.tools.command_line import ROOT
from tests.warm import Popen

pytestmark = pytest.mark.thorough
INT, TERM, HUP = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
BEGUN = ("cycle", "close", "report")
"""Moments at which a run has begun: there is a report of it."""


class Run:
    """`rack run` of a small rack whose upper level sends signals."""

    def __init__(
        self, small: Path, name: str, folder: Path, moment: str = "", numbers: tuple[int, ...] = ()
    ) -> None:
        text = small.read_text().replace(
            "two_levels:Upper", "tests.tools.console.signalling_levels:Signalling"
        )
        small.write_text(text.replace("two_levels:", "tests.two_levels:"))
        self.name, self.folder = name, folder
        seconds = () if moment == "cycle" else ("--seconds", "0.5")
        # At other times, a signal may come while the program is still being loaded.
        start = Popen if moment else subprocess.Popen
        self.process = start(
            [*RACK, "run", str(small), "--set", f"name={name}", "--out", folder, *seconds],
            cwd=ROOT,
            env={**os.environ, "MOMENT": moment, "SIGNALS": " ".join(str(int(n)) for n in numbers)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def end(self) -> tuple[int, str]:
        """Wait for an end that leaves nothing; return the exit status, as a shell has it, and what
        was said on stderr."""
        try:
            _, said = self.process.communicate(timeout=BOUND_S)
        finally:
            self.process.kill()
            self.process.communicate()
        # The boards die with the crate, a moment later.
        wait_until(lambda: not named(f"{self.name}:") and not children_of(self.process.pid))
        assert not [path.name for path in SHM_FOLDER.iterdir() if self.name in path.name]
        status = self.process.returncode
        return (128 - status if status < 0 else status), said

    def reported(self, said: str) -> bool:
        """Return whether there is a report; a slow machine has no time for it in 2 s, and then it
        says so."""
        is_there = (self.folder / "report.json").is_file()
        return is_there or "no time for the report: 'rack report" in said


@pytest.mark.parametrize(
    ("moment", "number"),
    # Each moment once, and each signal during the launch. During the run: SIGHUP below, SIGINT in
    # test_commands.py.
    [("config", HUP), ("crate", TERM), ("self-test", INT), ("cycle", TERM), ("close", INT)],
)
def test_a_signal_at_any_moment_ends_a_run_and_leaves_nothing(
    small: Path, rack_name: str, tmp_path: Path, moment: str, number: signal.Signals
) -> None:
    run = Run(small, rack_name, tmp_path / "run", moment, (number,))
    status, said = run.end()
    assert status == 128 + number, said
    assert "Traceback" not in said
    assert "cannot import" not in said
    assert run.reported(said) == (moment in BEGUN)


def test_a_signal_while_the_report_is_made_ends_the_command_after_it(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    run, log = Run(small, rack_name, tmp_path / "run"), tmp_path / "run" / "events.jsonl"
    wait_until(lambda: log.is_file() and '"outcome"' in log.read_text())
    run.process.send_signal(TERM)
    status, said = run.end()
    assert status == 128 + TERM
    assert run.reported(said)


@pytest.mark.parametrize("delay_s", [0.02, 0.25, 0.6])
def test_a_signal_to_the_whole_group_after_any_time_leaves_nothing(
    small: Path, rack_name: str, tmp_path: Path, delay_s: float
) -> None:
    number = (INT, TERM, HUP)[int(delay_s * 100) % 3]
    run = Run(small, rack_name, tmp_path / "run", "", (number,))
    time.sleep(delay_s)
    os.killpg(run.process.pid, number)
    status, said = run.end()
    # Before the command has come to its first line it is Python's own end.
    assert status == 128 + number or (delay_s < 0.1 and status), said


def test_closing_the_terminal_ends_a_run_in_order(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    pid, terminal = pty.fork()
    if pid == 0:
        words = ["run", str(small), "--set", f"name={rack_name}", "--set", "clock.mode=realtime"]
        os.chdir(ROOT)
        os.execv(sys.executable, [*RACK, *words, "--out", str(tmp_path / "run")])
    log = tmp_path / "run" / "events.jsonl"
    while not (log.is_file() and '"start"' in log.read_text()):
        os.read(terminal, 1 << 16)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(status) == 128 + HUP
    # Ended in order, and not by the bound of the wait for that: nobody has heard that there was no
    # time.
    assert '"SIGHUP received"' in log.read_text()
    assert not [path.name for path in SHM_FOLDER.iterdir() if rack_name in path.name]


def test_under_nohup_a_run_outlives_its_terminal_and_ends_by_other_signals(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    before = signal.signal(HUP, signal.SIG_IGN)
    try:
        run = Run(small, rack_name, tmp_path / "run", "cycle", (HUP, TERM))
    finally:
        signal.signal(HUP, before)
    status, said = run.end()
    assert status == 128 + TERM
    assert "SIGTERM received" in said + (tmp_path / "run" / "events.jsonl").read_text()
