"""Who is alive: processes told apart by pid and start time, for a pid comes back."""

from __future__ import annotations

import os
from pathlib import Path


def start_time(pid: int) -> int:
    """Return when a process started, in kernel clock ticks since boot; 0 when there is none or it is a zombie."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return 0
    # The command name, in parentheses, may itself hold spaces and parentheses.
    fields = stat.rpartition(")")[2].split()
    return 0 if fields[0] in "ZX" else int(fields[19])


def is_alive(pid: int, started: int = 0) -> bool:
    """Say whether the process runs; with `started`, whether it is still that same process."""
    found = start_time(pid) if pid > 0 else 0
    return found > 0 and started in (0, found)


def pin(core: int) -> None:
    """Pin the calling process to one core. Raises `OSError` when the machine lacks it."""
    os.sched_setaffinity(0, {core})
