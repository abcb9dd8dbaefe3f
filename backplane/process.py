"""Who is alive: processes told apart by pid and start time, for a pid comes back."""

from __future__ import annotations

import os
import select
from pathlib import Path
from time import process_time_ns

GONE = "ZX"
"""States of a process that has ended."""
WAITING = "SD"
"""States of a process that waits for something."""
_TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")
STOPPED = "Tt"
"""States of a process that a signal, or a debugger, has stopped."""


def start_time(pid: int) -> int:
    """Return when a process started, in kernel clock ticks since boot; 0 when there is none or it is a zombie."""
    fields = _stat(pid)
    return int(fields[19]) if fields and fields[0] not in GONE else 0


def state_of(pid: int) -> str:
    """Return the kernel's letter for what a process does: R, S, D, T (stopped), Z (dead, not reaped); X: no process."""
    return (_stat(pid) or "X")[0]


def processor_ns(pid: int) -> int:
    """Return the processor time that a process has used so far, in ns, to about 10 ms; 0 when there is none."""
    fields = _stat(pid)
    return (int(fields[11]) + int(fields[12])) * (1_000_000_000 // _TICKS_A_SECOND) if fields else 0


def _stat(pid: int) -> list[str]:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return []
    # The command name, in parentheses, may itself hold spaces and parentheses.
    return stat.rpartition(")")[2].split()


def is_alive(pid: int, started: int = 0) -> bool:
    """Say whether the process runs; with `started`, whether it is still that same process."""
    found = start_time(pid) if pid > 0 else 0
    return found > 0 and started in (0, found)


def readable(fd: int, timeout_s: float) -> bool:
    """Wait until a descriptor can be read, a pidfd until its process has ended; False when the time is over.

    Whatever its number: `select` takes none above 1023.
    """
    waiting = select.poll()
    waiting.register(fd, select.POLLIN)
    return bool(waiting.poll(max(0.0, timeout_s) * 1000))


def compute_until(processor_time_ns: int) -> None:
    """Compute until the calling process has used that much processor time, as `process_time_ns` counts it.

    Time in which it is preempted does not count.
    """
    while process_time_ns() < processor_time_ns:
        pass


def pin(core: int) -> None:
    """Pin the calling process to one core. Raises `OSError` when the machine lacks it."""
    os.sched_setaffinity(0, {core})
