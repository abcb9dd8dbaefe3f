"""What a rack leaves when it has ended: nothing, or it is counted here."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

from rack.backplane.process import is_alive, readable
from rack.backplane.segment import SHM_FOLDER

BOUND_S = 2.0
"""Time that processes which were killed get to be gone."""
COMM_LENGTH = 15
"""What the kernel keeps of a process's name."""


def children() -> set[int]:
    """Return the living processes that descend from this one."""
    found: set[int] = set()
    waiting = [os.getpid()]
    while waiting:
        pid = waiting.pop()
        with suppress(FileNotFoundError, ProcessLookupError):
            for path in Path(f"/proc/{pid}/task").glob("*/children"):
                new = {int(child) for child in path.read_text().split()} - found
                found |= new
                waiting += new
    return {pid for pid in found if is_alive(pid)}


def left_behind(rack: str, before: set[int]) -> list[str]:
    """Return what is left of a rack: segments and semaphores by name, processes by pid, each as one readable text.

    `before`: descendants of this process that were there before the rack.
    """
    _await_end({*_named(rack), *(children() - before)})
    files = [f"/dev/shm/{path.name}" for path in sorted(SHM_FOLDER.iterdir()) if rack in path.name]
    processes = sorted({*_named(rack), *(children() - before)})
    return files + [f"process {pid} ({_name(pid)})" for pid in processes]


def _named(rack: str) -> set[int]:
    """Return the processes named as the boards of a rack are, whoever their parent is."""
    start = f"{rack}:"[:COMM_LENGTH]
    pids = (int(path.name) for path in Path("/proc").glob("[0-9]*"))
    return {pid for pid in pids if _name(pid).startswith(start) and is_alive(pid)}


def _name(pid: int) -> str:
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/comm").read_text().rstrip("\n")
    return ""


def _await_end(pids: set[int]) -> None:
    deadline = time.monotonic() + BOUND_S
    for pid in pids:
        try:
            descriptor = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        try:
            readable(descriptor, deadline - time.monotonic())
        finally:
            os.close(descriptor)
