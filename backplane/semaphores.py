"""The named semaphores of a rack: two per task, to wake it and for its reports to lockstep; one per
locked mailbox.

The Rack makes them, the crate opens them before it forks the boards, and the names are then
removed: the boards keep the open semaphores, and no name is left over even if they are killed.

`posix_ipc` waits by the wall clock: if that is set back by an hour, a wait of 2 ms takes an hour.
The C library can wait by CLOCK_MONOTONIC (since glibc 2.30). Alternatives considered: a futex
through ctypes, and an eventfd with `poll`; both wake up more slowly.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Sequence
from functools import partial
from mmap import PAGESIZE

import posix_ipc

from rack.backplane.errors import SegmentError
from rack.backplane.layout import Layout
from rack.backplane.segment import PREFIX, SHM_FOLDER, no_room

_libc = ctypes.CDLL(None)
_sem_open = _libc.sem_open
_sem_clockwait = _libc.sem_clockwait
_sem_close = _libc.sem_close
_sem_open.argtypes = (ctypes.c_char_p, ctypes.c_int)
_sem_open.restype = ctypes.c_void_p
_sem_close.argtypes = (ctypes.c_void_p,)
_sem_clockwait.argtypes = ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p


class Semaphore(posix_ipc.Semaphore):  # type: ignore[misc]  # posix_ipc has no types
    """An open semaphore whose waits do not depend on the wall clock.

    `wait()` waits until the time set by `bind`, and returns 0 when it has obtained the semaphore. A
    signal may end it early. It is the C library's own; calling it through ctypes takes some
    microseconds of processor time, so waits that need no exact bound have `await_post`.
    """

    def __init__(self, name: str) -> None:
        """Open the semaphore of that name. Raises `posix_ipc.ExistentialError`."""
        super().__init__(name)
        # The same semaphore: the C library opens a name once in a process.
        self._address = address = _sem_open(name.encode(), 0)
        # A struct timespec, read by the C library in place.
        self._deadline = (ctypes.c_int64 * 2)()
        self.wait = partial(
            _sem_clockwait, address, time.CLOCK_MONOTONIC, ctypes.addressof(self._deadline)
        )

    def close(self) -> None:
        """Close it, both times."""
        super().close()
        _sem_close(self._address)

    def bind(self, deadline_ns: int) -> None:
        """Let waits end at that time, CLOCK_MONOTONIC."""
        self._deadline[0], self._deadline[1] = divmod(deadline_ns, 1_000_000_000)

    def take(self) -> bool:
        """Obtain the semaphore if that needs no wait; else return False."""
        return self.await_post(0)

    def await_post(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s` by the wall clock; False after that.

        Only for waits whose bound hardly matters: if the wall clock is set back, they take longer.
        """
        try:
            super().acquire(timeout_s)
        except posix_ipc.BusyError:
            return False
        return True

    def acquire(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s`; False after that."""
        if self.take():
            return True
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        self.bind(deadline_ns)
        while self.wait():
            if time.monotonic_ns() >= deadline_ns:
                return False
        return True


_OPEN: dict[str, Semaphore] = {}
"""Semaphores open in this process; forked boards inherit them."""


def names(layout: Layout) -> list[str]:
    """Return the POSIX names of every semaphore that a rack needs."""
    wake = [_name(layout.rack, "wake", task.name) for task in layout.processes]
    locks = [_name(layout.rack, "lock", m.name) for m in layout.mailboxes if m.protocol == "lock"]
    done = [_name(layout.rack, "done", task.name) for task in layout.processes]
    return [*wake, *done, *locks]


def create(layout: Layout) -> None:
    """Make every semaphore of a rack, replacing those left by a killed rack of that name.

    Raises `SegmentError` when one is another user's or memory is short.
    """
    every = names(layout)
    for name in every:
        _unlink(name)
        initial = 1 if name.startswith(_name(layout.rack, "lock", "")) else 0
        try:
            posix_ipc.Semaphore(name, posix_ipc.O_CREX, mode=0o600, initial_value=initial).close()
        except posix_ipc.ExistentialError:
            why = (
                "belongs to another user: only that user may remove it; choose another name for the"
                " rack"
            )
            raise SegmentError(
                f"rack '{layout.rack}': semaphore {SHM_FOLDER}/sem.{name[1:]} {why}"
            ) from None
        except OSError as error:
            raise no_room(
                layout.rack, f"{len(every)} semaphores of {PAGESIZE} bytes", error
            ) from None


def open_all(layout: Layout) -> None:
    """Open every semaphore of a rack in this process."""
    for name in names(layout):
        _OPEN[name] = Semaphore(name)


def close_all() -> None:
    """Close every semaphore that is open in this process."""
    while _OPEN:
        _OPEN.popitem()[1].close()


def unlink(layout: Layout, kept: Sequence[str] = ()) -> None:
    """Remove the names; processes keep the semaphores that they have open. Those that wake `kept`
    keep theirs."""
    wake = [_name(layout.rack, "wake", host) for host in kept]
    for name in names(layout):
        if name not in wake:
            _unlink(name)


def unlink_all(rack: str) -> None:
    """Remove every semaphore name of a rack whose layout is not known."""
    # The C library keeps semaphores in the segments' folder, with its own prefix. A rack's name has
    # no dot.
    for path in SHM_FOLDER.glob(f"sem.{PREFIX}{rack}.*"):
        _unlink(f"/{path.name.removeprefix('sem.')}")


def wake_semaphore(rack: str, task: str) -> Semaphore:
    """Return the open semaphore that wakes a task."""
    return _opened(_name(rack, "wake", task))


def done_semaphore(rack: str, task: str) -> Semaphore:
    """Return the open semaphore on which lockstep waits for a task's reports, or for the crate to
    report its loss."""
    return _opened(_name(rack, "done", task))


def lock_semaphore(rack: str, mailbox: str) -> Semaphore:
    """Return the open semaphore that guards a mailbox."""
    return _opened(_name(rack, "lock", mailbox))


def _opened(name: str) -> Semaphore:
    if name not in _OPEN:
        _OPEN[name] = Semaphore(name)
    return _OPEN[name]


def _name(rack: str, *parts: str) -> str:
    return f"/{PREFIX}{'.'.join((rack, *parts))}"


def _unlink(name: str) -> None:
    try:
        posix_ipc.unlink_semaphore(name)
    except (posix_ipc.ExistentialError, posix_ipc.PermissionsError):
        # There is none, or it is another user's, who alone may remove it.
        return
