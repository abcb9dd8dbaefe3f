"""Semaphores of a rack, in the segment itself.

A task has two, one to wake it and one for its reports to lockstep. A locked mailbox has one. They
are unnamed semaphores of the C library, so no name can be left over, and a copy of the segment has
separate ones. `posix_ipc` supports only named semaphores and waits by the wall clock: if the clock
is set back by an hour, a wait of 2 ms takes an hour. The C library can wait by CLOCK_MONOTONIC
(since glibc 2.30).

Alternatives considered: a futex through ctypes, and an eventfd with `poll`. Both wake up more
slowly.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from functools import partial
from typing import Protocol

from rack.backplane.address_map import AddressMap

_libc = ctypes.CDLL(None)
# Calls that never block keep the interpreter's lock, which makes them faster.
_quick = ctypes.PyDLL(None)
_sem_clockwait = _libc.sem_clockwait
_sem_init = _quick.sem_init
_sem_post = _quick.sem_post
_sem_trywait = _quick.sem_trywait
_sem_getvalue = _quick.sem_getvalue
_sem_clockwait.argtypes = ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p
_sem_init.argtypes = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint
_sem_post.argtypes = _sem_trywait.argtypes = (ctypes.c_void_p,)
_sem_getvalue.argtypes = ctypes.c_void_p, ctypes.c_void_p


class MappedMemory(Protocol):
    """Memory of a segment and its address map."""

    bytes: memoryview
    map: AddressMap


class Semaphore:
    """Semaphore in shared memory whose waits do not depend on the wall clock.

    `release()` posts it. `wait()` waits for a post until the time set by `set_deadline`, and
    returns 0 if it has obtained the semaphore. Any other result means that the time has passed or
    that a signal has ended the wait early.
    """

    def __init__(self, memory: memoryview, address: int) -> None:
        """Access the semaphore at a bus address of a segment's memory."""
        # This view keeps the memory mapped for as long as the semaphore is in use.
        self._memory = ctypes.c_char.from_buffer(memory, address)
        at = ctypes.addressof(self._memory)
        # A struct timespec, read by the C library in place.
        self._deadline = (ctypes.c_int64 * 2)()
        self.release: Callable[[], object] = partial(_sem_post, at)
        self.wait: Callable[[], int] = partial(
            _sem_clockwait, at, time.CLOCK_MONOTONIC, ctypes.addressof(self._deadline)
        )
        self._try = partial(_sem_trywait, at)

    def initialize(self, value: int) -> None:
        """Create the semaphore with an initial value, shared by all processes that map it."""
        _sem_init(ctypes.addressof(self._memory), 1, value)

    @property
    def value(self) -> int:
        """Value of the semaphore: the number of waits that would succeed at once."""
        count = ctypes.c_int()
        _sem_getvalue(ctypes.addressof(self._memory), ctypes.addressof(count))
        return count.value

    def set_deadline(self, deadline_ns: int) -> None:
        """Set the time at which waits end, in ns of CLOCK_MONOTONIC."""
        self._deadline[0], self._deadline[1] = divmod(deadline_ns, 1_000_000_000)

    def try_acquire(self) -> bool:
        """Obtain the semaphore without waiting. Returns False if its value is 0."""
        return not self._try()

    def acquire(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` for the semaphore. Returns False on timeout."""
        if self.try_acquire():
            return True
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        self.set_deadline(deadline_ns)
        while self.wait():
            if time.monotonic_ns() >= deadline_ns:
                return False
        return True


def get_wake_semaphore(segment: MappedMemory, task: str) -> Semaphore:
    """Return the semaphore that wakes a task."""
    return Semaphore(segment.bytes, segment.map.wake[task])


def get_done_semaphore(segment: MappedMemory, task: str) -> Semaphore:
    """Return the semaphore on which the clock waits for a task in lockstep.

    The task posts it to report a finished release, and the crate posts it to report that the task
    is lost.
    """
    return Semaphore(segment.bytes, segment.map.done[task])


def get_lock_semaphore(segment: MappedMemory, mailbox: str) -> Semaphore:
    """Return the semaphore of a mailbox under protocol lock."""
    return Semaphore(segment.bytes, segment.map.locks[mailbox])
