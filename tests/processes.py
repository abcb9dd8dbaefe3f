"""Processes and threads for tests, and waits that end."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from rack.backplane.errors import SegmentError
from rack.backplane.process import is_alive
from rack.backplane.segment import Segment
from rack.backplane.words import System
from tests import warm

RACK = (sys.executable, "-m", "rack.tools.cli")
"""The `rack` command of the environment that runs the tests."""
BOUND_S = 50.0
"""Bound of every wait: reached only when something is broken, on a machine ten times slower too."""
FORKS = "ignore:.*multi-threaded, use of fork:DeprecationWarning"
"""Filter for tests that fork: a worker here touches shared memory alone, none of the parent's
threads' locks."""


def fork(work: Callable[[], object]) -> int:
    """Run `work` in a child process; its exit status is 0 when `work` returned true or nothing."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        status = 0 if work() in (None, True) else 2
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


@contextmanager
def forked(work: Callable[[], object]) -> Iterator[int]:
    """Run `work` in a child process that is killed at the end, should it still run."""
    pid = fork(work)
    try:
        yield pid
    finally:
        kill(pid)


def kill(pid: int) -> None:
    """Kill a child of this process and reap it."""
    with suppress(ProcessLookupError, ChildProcessError):
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def exit_status(pid: int, bound_s: float = BOUND_S) -> int:
    """Wait for a child's end and return its exit status, negative for a signal."""
    how = os.WEXITED | os.WNOHANG | os.WNOWAIT
    wait_until(lambda: os.waitid(os.P_PID, pid, how) is not None, bound_s)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def wait_until(condition: Callable[[], object], bound_s: float = BOUND_S) -> None:
    """Wait until `condition` holds. Raises `TimeoutError` when it does not come to."""
    deadline = time.monotonic() + bound_s
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"not within {bound_s:g} s")
        time.sleep(0.001)


def run_to_end(
    command: Sequence[str | bytes | Path], bound_s: float, *, check: bool = False, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end, within a bound; return its exit status and what it printed."""
    return subprocess.run(
        command, capture_output=True, text=True, timeout=bound_s, check=check, **options
    )


def start_rack(command: Sequence[str | Path], name: str, log: Path) -> subprocess.Popen[bytes]:
    """Start a command that runs a rack, and return once the rack has begun to tick.

    What it says is in the file `log`: a rack in real time on a busy machine says so much that a
    pipe which nobody reads would be full, and a launcher that waits for its reader restarts no
    board.
    """
    with log.open("w") as said:
        process = warm.Popen(command, stdout=subprocess.DEVNULL, stderr=said)

    wait_until(lambda: is_ticking(name) or process.poll() is not None, 2 * BOUND_S)
    assert process.poll() is None, log.read_text()
    return process


def is_ticking(name: str) -> bool:
    """Return whether a rack has begun to tick."""
    # It may end, or not be whole yet.
    with suppress(SegmentError), closing(Segment.attach(name)) as segment:
        return segment.words[System.TICK] > 0
    return False


@contextmanager
def in_thread(run: Callable[[], object]) -> Iterator[None]:
    """Run something beside the test; at the end it must come to its own end."""
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield
    thread.join(BOUND_S)
    assert not thread.is_alive()


def runs(pid: int) -> bool:
    """Say whether a process is there and no zombie."""
    return is_alive(pid)


def parent_of(pid: int) -> int:
    """Return the parent of a running process."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def children_of(pid: int) -> list[int]:
    """Return the children of a process; none when it is gone."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return [
            int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        ]
    return []


def own_can_channel() -> str:
    """Return the address of a CAN bus on UDP multicast that no other process of tests uses."""
    return f"239.75.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"


def descriptors() -> int:
    """Return how many files this process has open and in use."""
    gc.collect()
    # What is left lives on: the next collection, a third of a second otherwise, leaves it out.
    gc.freeze()
    return open_files()


def open_files() -> int:
    """Return how many files this process has open, used or not."""
    return len(list(Path("/proc/self/fd").iterdir()))


def named(start: str) -> list[int]:
    """Return the processes whose name, as `ps` shows it, begins like that; the kernel keeps 15
    characters of it."""
    found = []
    for path in Path("/proc").glob("[0-9]*/comm"):
        with suppress(FileNotFoundError, ProcessLookupError):
            pid = int(path.parent.name)
            if path.read_text().rstrip("\n").startswith(start[:15]) and runs(pid):
                found.append(pid)
    return found
