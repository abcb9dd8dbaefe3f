"""The named semaphores of a rack: one wake-up a task, one for the clock, one a locked mailbox.

The Rack makes them, the crate opens them before it forks the boards, and the names are removed at
once: the boards keep the open semaphores, and nothing is left behind however they end.

`posix_ipc` waits by the wall clock: set back by an hour, a bound of 2 ms would end an hour later. The C library has a
wait by CLOCK_MONOTONIC too (glibc 2.30). Alternatives considered: a futex by hand, and an eventfd with `poll`, are
slower to wake up.
"""

from __future__ import annotations

import ctypes
import time
from functools import partial

import posix_ipc

from rack.backplane.layout import Layout
from rack.backplane.segment import PREFIX, SHM_FOLDER

_libc = ctypes.CDLL(None)
_sem_open, _sem_clockwait = _libc.sem_open, _libc.sem_clockwait
_sem_open.argtypes, _sem_open.restype = (ctypes.c_char_p, ctypes.c_int), ctypes.c_void_p
_sem_clockwait.argtypes = ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p


class Semaphore(posix_ipc.Semaphore):  # type: ignore[misc]  # posix_ipc has no types
    """An open semaphore whose waits no step of the wall clock makes longer or shorter.

    `wait()` waits until what `bind` has set, and returns 0 when it has obtained the semaphore: it is the C library's
    own function, for whoever must be awake at once. A signal may end it early.
    """

    def __init__(self, name: str) -> None:
        """Open the semaphore of that name. Raises `posix_ipc.ExistentialError`."""
        super().__init__(name)
        # The same one: the C library opens a name once in a process.
        address = _sem_open(name.encode(), 0)
        # A struct timespec, which the C library reads where it is.
        self._deadline = (ctypes.c_int64 * 2)()
        self.wait = partial(_sem_clockwait, address, time.CLOCK_MONOTONIC, ctypes.addressof(self._deadline))

    def bind(self, timeout_s: float) -> int:
        """Have waits end in `timeout_s` from now; return when that is, CLOCK_MONOTONIC, ns."""
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        self._deadline[0], self._deadline[1] = divmod(deadline_ns, 1_000_000_000)
        return deadline_ns

    def acquire(self, timeout_s: float) -> bool:
        """Wait for that long at most; False when it was in vain."""
        try:
            super().acquire(0)
        except posix_ipc.BusyError:
            deadline_ns = self.bind(timeout_s)
            while self.wait():
                if time.monotonic_ns() >= deadline_ns:
                    return False
        return True


_OPEN: dict[str, Semaphore] = {}
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
        _OPEN[name] = Semaphore(name)


def unlink(layout: Layout) -> None:
    """Remove the names; whoever has a semaphore open keeps it."""
    for name in names(layout):
        _unlink(name)


def unlink_all(rack: str) -> None:
    """Remove every semaphore name of a rack whose layout is not known."""
    # The C library keeps semaphores beside the segments, with a prefix of its own. No rack's name holds a dot.
    for path in SHM_FOLDER.glob(f"sem.{PREFIX}{rack}.*"):
        _unlink(f"/{path.name.removeprefix('sem.')}")


def wake_semaphore(rack: str, task: str) -> Semaphore:
    """Return the open semaphore that wakes a task."""
    return _opened(_wake(rack, task))


def clock_semaphore(rack: str) -> Semaphore:
    """Return the open semaphore on which lockstep waits for tasks to finish."""
    return _opened(_clock(rack))


def lock_semaphore(rack: str, mailbox: str) -> Semaphore:
    """Return the open semaphore that guards a mailbox."""
    return _opened(_lock(rack, mailbox))


def _opened(name: str) -> Semaphore:
    if name not in _OPEN:
        _OPEN[name] = Semaphore(name)
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
