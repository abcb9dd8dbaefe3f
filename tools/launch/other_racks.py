"""Launches the racks named in `adapter.lan.launch`, each by `rack run` in a separate process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Self

from rack.backplane.process import describe_end, die_with_parent
from rack.boards.config.schema import RackConfig
from rack.tools.console.answer import Document

MAX_END_S = 60.0
"""Longest wait for the end of the other racks after this rack's end, including their reports."""
MAX_STOP_S = 3.0
"""Longest wait for the end of a rack that is stopped."""


@dataclass(frozen=True)
class OtherRackEnd:
    """Outcome of the run of another rack. `folder` is None if the run was not recorded."""

    rack: str
    cause: str
    ticks: int
    digest: str
    folder: str | None


class LaunchedProcess(NamedTuple):
    """Process of another rack. It prints its report to a memory file, which needs no reader."""

    config: str
    process: subprocess.Popen[bytes]
    report: int


class OtherRacks:
    """Other racks that are launched with this one. Leaving the context ends them all."""

    def __init__(
        self, configs: Sequence[str], config: RackConfig, seconds: float | None, is_recorded: bool
    ) -> None:
        """Launch racks with the clock and the duration of this rack.

        Args:
            configs: Names or paths of their configs.
            config: Config of this rack.
            seconds: Simulated time of the run, or None.
            is_recorded: False to record none of them.
        """
        options = ["--json", "--share", f"--speed={config.clock.speed}"]
        options += ["--lockstep"] if config.is_lockstep else []
        options += [] if seconds is None else [f"--seconds={seconds}"]
        options += [] if is_recorded else ["--no-record"]
        self._is_stopped = False
        self._failed = ""
        self._racks: list[LaunchedProcess] = []
        for other in configs:
            report = os.memfd_create("report")
            # Use a new process group. Otherwise Ctrl-C would reach the rack twice, from the
            # terminal and from this process.
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "rack.tools.cli", "run", other, *options],
                stdin=subprocess.DEVNULL,
                stdout=report,
                process_group=0,
                preexec_fn=partial(die_with_parent, os.getpid()),
            )
            self._racks.append(LaunchedProcess(other, process, report))

    def __len__(self) -> int:
        return len(self._racks)

    def describe_failures(self) -> str:
        """Describe which of the racks have failed so far, and why. Empty if none has."""
        # Racks stopped by this process end by a signal, which does not count as a failure.
        if not self._is_stopped:
            failed = [rack for rack in self._racks if rack.process.poll()]
            self._failed = "; ".join(f"{rack.config}: {_describe_failure(rack)}" for rack in failed)
        return self._failed

    def stop_racks(self) -> None:
        """Ask all of these racks to end."""
        self._is_stopped = True
        for rack in self._racks:
            rack.process.terminate()

    def await_end(self) -> str:
        """Wait until the racks have ended. Returns failures as `describe_failures` does."""
        deadline = time.monotonic() + (MAX_STOP_S if self._is_stopped else MAX_END_S)
        late = []
        for rack in self._racks:
            try:
                rack.process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                late.append(f"{rack.config}: still running")
        return "; ".join(late) or self.describe_failures()

    def list_ends(self) -> Iterator[OtherRackEnd]:
        """Yield how each rack that ran has ended."""
        for rack in self._racks:
            report = _read_report(rack)
            if outcome := report.get("outcome"):
                end = outcome["cause"], outcome["ticks"], outcome["digest"]
                yield OtherRackEnd(report["rack"], *end, report["folder"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop_racks()
        self.await_end()
        for rack in self._racks:
            rack.process.kill()
            os.close(rack.report)


def _read_report(rack: LaunchedProcess) -> Document:
    """Return the report of a rack, or an empty document if it is incomplete."""
    with suppress(ValueError):
        report: Document = json.loads(os.pread(rack.report, os.fstat(rack.report).st_size, 0))
        return report
    return {}


def _describe_failure(rack: LaunchedProcess) -> str:
    """Describe why a rack failed."""
    report = _read_report(rack)
    why = report.get("failures") or report.get("error")
    return "; ".join(why or [describe_end(rack.process.returncode)])
