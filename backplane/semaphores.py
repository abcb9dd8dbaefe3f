"""The named semaphores of a rack: one wake-up a task, one for the clock, one a locked mailbox.

The Rack makes them, the crate opens them before it forks the boards, and the names are removed at
once: the boards keep the open semaphores, and nothing is left behind however they end.
"""

from __future__ import annotations

import posix_ipc

from backplane.layout import Layout
from backplane.segment import PREFIX, SHM_FOLDER

_OPEN: dict[str, posix_ipc.Semaphore] = {}
"""Semaphores open in this process; forked boards inherit them."""


def names(layout: Layout) -> list[str]:
    """Return the POSIX names of every semaphore that a rack needs."""
    wake = [_wake(layout.rack, task.name) for task in layout.tasks]
    locks = [_lock(layout.rack, m.name) for m in layout.mailboxes if m.protocol == "lock"]
    return [_clock(layout.rack), *wake, *locks]


def create(layout: Layout) -> None:
    """Make every semaphore of a rack, replacing what a killed rack of that name left."""
    for name in names(layout):
        _unlink(name)
        initial = 1 if name.startswith(_lock(layout.rack, "")) else 0
        posix_ipc.Semaphore(name, posix_ipc.O_CREX, mode=0o600, initial_value=initial).close()


def open_all(layout: Layout) -> None:
    """Open every semaphore of a rack in this process."""
    for name in names(layout):
        _OPEN[name] = posix_ipc.Semaphore(name)


def unlink(layout: Layout) -> None:
    """Remove the names; whoever has a semaphore open keeps it."""
    for name in names(layout):
        _unlink(name)


def unlink_all(rack: str) -> None:
    """Remove every semaphore name of a rack whose layout is not known."""
    # The C library keeps semaphores beside the segments, with a prefix of its own. No rack's name holds a dot.
    for path in SHM_FOLDER.glob(f"sem.{PREFIX}{rack}.*"):
        _unlink(f"/{path.name.removeprefix('sem.')}")


def wake_semaphore(rack: str, task: str) -> posix_ipc.Semaphore:
    """Return the open semaphore that wakes a task."""
    return _opened(_wake(rack, task))


def clock_semaphore(rack: str) -> posix_ipc.Semaphore:
    """Return the open semaphore on which lockstep waits for tasks to finish."""
    return _opened(_clock(rack))


def lock_semaphore(rack: str, mailbox: str) -> posix_ipc.Semaphore:
    """Return the open semaphore that guards a mailbox."""
    return _opened(_lock(rack, mailbox))


def _opened(name: str) -> posix_ipc.Semaphore:
    if name not in _OPEN:
        _OPEN[name] = posix_ipc.Semaphore(name)
    return _OPEN[name]


def _clock(rack: str) -> str:
    return f"/{PREFIX}{rack}.clock"


def _wake(rack: str, task: str) -> str:
    return f"/{PREFIX}{rack}.wake.{task}"


def _lock(rack: str, mailbox: str) -> str:
    return f"/{PREFIX}{rack}.lock.{mailbox}"


def _unlink(name: str) -> None:
    try:
        posix_ipc.unlink_semaphore(name)
    except posix_ipc.ExistentialError:
        return
