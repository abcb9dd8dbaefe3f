"""A realtime thread of LinuxCNC on the same grid: its HAL component `timedelta` measures the time
from run to run, and `sampler` hands every value to us.

An interval has no grid point, so the grid is taken from the thread's earliest run: its lateness is
too low by that of its best wake. On a kernel without PREEMPT_RT, or without `iopl`, LinuxCNC leaves
its threads under ordinary scheduling; the bench then gives this one the priority of the others, and
its core in any case.
"""

from __future__ import annotations

import os
import pwd
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.cyclictest import WakeGrid
from rack.tools.lab.benches.harness import Absent, absent_program, last_line

LINUXCNC = "LinuxCNC thread"
PACKAGE = "linuxcnc-uspace"
PROGRAM = "halrun"
THREAD = "rtapi_app:T#0"
"""Name that LinuxCNC gives to its first realtime thread."""
START_S = 10.0
END_S = 5.0
SETUP = """\
loadrt threads name1=grid period1={period_ns} fp1=0
loadrt timedelta count=1
loadrt sampler depth=4096 cfg=s
addf timedelta.0 grid
addf sampler.0 grid
net interval timedelta.0.out => sampler.0.pin.0
"""
MEASURE = """\
start
loadusr -w halsampler -n {samples}
"""
SILENT = "it printed no interval"
LEAD = 3
"""Samples before the first interval from one run to the next."""


def absent_linuxcnc() -> tuple[Absent, ...]:
    """Return what LinuxCNC lacks; nothing if it is installed."""
    return absent_program(LINUXCNC, PROGRAM, PACKAGE)


def linuxcnc(grid: WakeGrid) -> np.ndarray:
    """Return the lateness of every run of the thread, us, shape (n,). Raises `Failure` if LinuxCNC
    does not run it."""
    others = _threads()
    with TemporaryDirectory(prefix="rack-bench-") as folder, _hal(Path(folder)) as hal:
        assert hal.stdin is not None
        # If it has ended, its stderr says why.
        with suppress(BrokenPipeError):
            hal.stdin.write(SETUP.format(period_ns=grid.period_ns))
            hal.stdin.flush()
        _schedule(_await_thread(hal, others), grid)
        try:
            out, err = hal.communicate(MEASURE.format(samples=grid.wakes + LEAD), grid.patience_s)
        except subprocess.TimeoutExpired:
            raise Failure(f"{LINUXCNC}: still running after {grid.patience_s:g} s") from None
    found = np.array([line for line in out.split() if line.lstrip("-").isdigit()][LEAD:], np.int64)
    if not len(found):
        raise Failure(f"{LINUXCNC}: {last_line(err, SILENT)}")
    return lateness_us(found, grid.period_ns)


def lateness_us(intervals_ns: np.ndarray, period_ns: int) -> np.ndarray:
    """Return how late each run came after the earliest one's grid, us, shape (n,), from the time
    since the last run."""
    late_ns = np.cumsum(intervals_ns - period_ns)
    return np.asarray((late_ns - late_ns.min()) * 1e-3)


@contextmanager
def _hal(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Give a LinuxCNC that takes HAL commands on stdin; nothing of it is left when the context
    ends."""
    pipe = subprocess.PIPE
    environment = _environment(folder)
    hal = subprocess.Popen(
        [PROGRAM],
        cwd=folder,
        env=environment,
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        text=True,
        start_new_session=True,
    )
    try:
        yield hal
    finally:
        if hal.poll() is None:
            os.killpg(hal.pid, signal.SIGKILL)
            hal.wait()
            # Its realtime process is a daemon: it outlives its command line, and keeps the pipes
            # open.
            end = [PROGRAM, "-U"]
            none = subprocess.DEVNULL
            subprocess.run(
                end,
                cwd=folder,
                env=environment,
                stdout=none,
                stderr=none,
                timeout=END_S,
                check=False,
            )
        for stream in (hal.stdin, hal.stdout, hal.stderr):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()


def _environment(folder: Path) -> dict[str, str]:
    """Return an environment in which LinuxCNC runs in a folder of its own, and as root as another
    user."""
    folder.chmod(0o777)
    nobody = {} if os.getuid() else {"RTAPI_UID": str(pwd.getpwnam("nobody").pw_uid)}
    own = {
        "HOME": str(folder),
        "RTAPI_FIFO_PATH": str(folder / "fifo"),
        "LINUXCNC_FORCE_REALTIME": "1",
    }
    return {**os.environ, **own, **nobody}


def _await_thread(hal: subprocess.Popen[str], others: frozenset[int]) -> int:
    """Return the id of the realtime thread once it runs; `others` ran before."""
    until = time.monotonic() + START_S
    while hal.poll() is None and time.monotonic() < until:
        if own := _threads() - others:
            return min(own)
        time.sleep(0.02)
    if hal.poll() is None:
        raise Failure(f"{LINUXCNC}: it started no thread within {START_S:g} s")
    raise Failure(f"{LINUXCNC}: {last_line(hal.communicate()[1], SILENT)}")


def _threads() -> frozenset[int]:
    """Return the ids of all threads with the name of LinuxCNC's first."""
    found = set()
    for name in Path("/proc").glob("[0-9]*/task/[0-9]*/comm"):
        with suppress(OSError):
            if name.read_text().strip() == THREAD:
                found.add(int(name.parent.name))
    return frozenset(found)


def _schedule(thread: int, grid: WakeGrid) -> None:
    policy = os.SCHED_FIFO if grid.priority else os.SCHED_OTHER
    # A thread that has ended already leaves the reason on stderr.
    with suppress(PermissionError, ProcessLookupError):
        os.sched_setaffinity(thread, {grid.cores[0]})
        os.sched_setscheduler(thread, policy, os.sched_param(grid.priority))
