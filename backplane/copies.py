"""Copies of a rack's memory: one that is kept, and the change of a process from one segment to
another.

A process has thousands of views of its segment. They stay valid: the memory of another segment is
mapped at the address of the one before (`mmap` with `MAP_FIXED`). The kernel's locks are of the
other segment, too: what a process holds, it takes again there.
"""

from __future__ import annotations

import ctypes
import mmap
import os
from contextlib import suppress
from pathlib import Path

from rack.backplane import byte_lock
from rack.backplane.segment import Segment, shm_path
from rack.backplane.words import Block, Box, System, TaskState

_libc = ctypes.CDLL(None, use_errno=True)
_int = ctypes.c_int
_libc.mmap.argtypes = ctypes.c_void_p, ctypes.c_size_t, _int, _int, _int, ctypes.c_long
_libc.mmap.restype = ctypes.c_void_p
_MAP_FIXED = 0x10
OF_LAUNCH = (
    System.STATE,
    System.EPOCH_NS,
    System.PERIOD_NS,
    System.LOCKSTEP,
    System.STOP_REQUEST,
    System.STOP_TICK,
    System.FOLLOWER_PID,
    System.TICK_NS,
    System.CLOCK_PID,
    System.HOLD_AT,
    System.HELD,
    System.SNAPSHOT_AT,
    System.SNAPSHOT_PART,
    System.SNAPSHOT_EVERY,
    System.SNAPSHOTS,
    System.SNAPSHOT_BYTES,
)
"""Words that each launch has of its own."""


def copy_memory(segment: Segment) -> int:
    """Return a file, without a name, with the memory of a segment in which nothing happens."""
    fd = os.memfd_create("snapshot", os.MFD_CLOEXEC)
    written = 0
    while written < segment.map.size:
        written += os.write(fd, segment.bytes[written : segment.map.size])
    return fd


def fill_memory(segment: Segment, fd: int, tick: int) -> None:
    """Fill the segment of a rack that is being launched with a copy, to go on before `tick`.

    No task is there yet. A recorder finds what this rack writes, and nothing before it.
    """
    words = segment.words
    own = [(at, words[at]) for at in OF_LAUNCH]
    start = 8 * System.STATE
    os.preadv(fd, [segment.bytes[start : segment.map.size]], start)
    for at, value in own:
        words[at] = value
    words[System.FOLLOWER_TICK] = words[System.FOLLOWER_DRAINED] = tick - 1
    for task in segment.layout.processes:
        block = segment.block(task.name)
        block[Block.STATE] = TaskState.ABSENT
        block[Block.TRACE_FIRST] = block[Block.TRACE_HEAD]
    for mailbox in segment.layout.mailboxes:
        box = segment.box(mailbox.name)
        box[Box.FIRST] = box[Box.HEAD]
    # Posts that nobody took mean nothing between two ticks.
    segment.initialize_semaphores()


def leave(segment: Segment) -> None:
    """Let go of a segment, in the fork of a process that goes on with it: its memory, its file and
    its locks. The fork must not use it before `enter`.
    """
    byte_lock.close_all()
    _map(segment, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, 0, -1)
    file = os.fstat(segment.fd)
    nothing = os.open(os.devnull, os.O_RDONLY)
    # Python's `mmap` has it open, too.
    for fd in [int(entry.name) for entry in Path("/proc/self/fd").iterdir()]:
        with suppress(OSError):
            if os.path.samestat(os.fstat(fd), file):
                os.dup2(nothing, fd)
    os.close(nothing)


def enter(segment: Segment, rack: str) -> None:
    """Redirect the views of `segment` to the segment of another rack with the same layout. Takes no
    lock and claims no mailbox.
    """
    fd = os.open(shm_path(rack), os.O_RDWR)
    segment.rack = rack
    os.dup2(fd, segment.fd)
    os.close(fd)
    _map(segment, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, segment.fd)
    byte_lock.reopen_all(segment.fd)


def _map(segment: Segment, flags: int, rights: int, fd: int) -> None:
    """Map a file, or nothing, in the place of a segment's memory."""
    place = ctypes.addressof(ctypes.c_char.from_buffer(segment.bytes))
    size = segment.map.size
    if _libc.mmap(place, size, rights, flags | _MAP_FIXED, fd, 0) != place:
        raise OSError(ctypes.get_errno(), "the memory of a segment cannot be mapped")
