"""Launchers as separate programs, and all their descendants."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.processes import BOUND_S, runs, wait_until
from tests.warm import Popen

ROOT = Path(__file__).parents[2]


class Program:
    """A launcher in its own session."""

    def __init__(self, config: Path, *settings: str) -> None:
        self._process = Popen(
            [sys.executable, "-m", "tests.boards.launcher", str(config), *settings],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self.pid = self._process.pid

    def wait_for_launch(self) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "launched\n"

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def ended(self) -> int:
        """Wait for the launcher's end and return its exit status."""
        return self._process.wait(BOUND_S)

    @property
    def descendants(self) -> list[int]:
        """The processes of the launcher's session that still run."""
        found = []
        for path in Path("/proc").glob("[0-9]*/stat"):
            with suppress(FileNotFoundError, ProcessLookupError):
                pid = int(path.parent.name)
                session = int(path.read_text().rpartition(")")[2].split()[3])
                if session == self.pid != pid and runs(pid):
                    found.append(pid)
        return found

    def wait_for_descendants(self) -> None:
        wait_until(lambda: not self.descendants)

    def close(self) -> None:
        for pid in [self.pid, *self.descendants]:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._process.wait(BOUND_S)
        assert self._process.stdout is not None
        self._process.stdout.close()


@contextmanager
def launcher(config: Path, *settings: str) -> Iterator[Program]:
    """Start a launcher; at the end, kill what remains of it."""
    program = Program(config, *settings)
    try:
        yield program
    finally:
        program.close()
