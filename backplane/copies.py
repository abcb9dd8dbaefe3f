"""Copies of a rack's memory, and the switch of a process from one segment to another.

A process holds thousands of views of its segment. They stay valid, because the memory of the new
segment is mapped at the address of the old one (`mmap` with `MAP_FIXED`). The process also takes
its kernel locks again, in the new segment.
"""

from __future__ import annotations

import ctypes
import mmap
import os
from contextlib import suppress
from pathlib import Path

from rack.backplane import byte_lock
from rack.backplane.segment import Segment, get_shm_path
from rack.backplane.words import Block, Box, System, TaskState

_libc = ctypes.CDLL(None, use_errno=True)
_int = ctypes.c_int
_libc.mmap.argtypes = ctypes.c_void_p, ctypes.c_size_t, _int, _int, _int, ctypes.c_long
_libc.mmap.restype = ctypes.c_void_p
_MAP_FIXED = 0x10
LAUNCH_WORDS = (
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
"""System words that belong to one launch and are not restored from a copy."""


def copy_memory(segment: Segment) -> int:
    """Copy the memory of a segment to an anonymous file, and return the file's descriptor.

    No process may write to the segment during the copy.
    """
    fd = os.memfd_create("snapshot", os.MFD_CLOEXEC)
    written = 0
    while written < segment.map.size:
        written += os.write(fd, segment.bytes[written : segment.map.size])
    return fd


def restore_memory(segment: Segment, fd: int, tick: int) -> None:
    """Restore a copy into the segment of a rack that is being launched.

    Call this before any of the rack's tasks has started. A recorder gets only the records and
    messages that the new rack writes: all that are in the copy are marked as read.

    Args:
        segment: Segment of the new rack.
        fd: File made by `copy_memory`.
        tick: First tick that the new rack runs.
    """
    words = segment.words
    launch_words = [(at, words[at]) for at in LAUNCH_WORDS]
    start = 8 * System.STATE
    os.preadv(fd, [segment.bytes[start : segment.map.size]], start)
    for at, value in launch_words:
        words[at] = value
    words[System.FOLLOWER_TICK] = words[System.FOLLOWER_DRAINED] = tick - 1
    for task in segment.layout.processes:
        block = segment.get_block(task.name)
        block[Block.STATE] = TaskState.ABSENT
        block[Block.TRACE_FIRST] = block[Block.TRACE_HEAD]
    for mailbox in segment.layout.mailboxes:
        box = segment.get_box(mailbox.name)
        box[Box.FIRST] = box[Box.HEAD]
    # Discard the posts that were pending at the time of the copy. No task of the new rack waits
    # for them.
    segment.initialize_semaphores()


def detach_segment(segment: Segment) -> None:
    """Detach a forked process from its segment: release the memory, the file and the locks.

    The process must not use the segment again before it calls `switch_segment`.
    """
    byte_lock.close_all_files()
    _map_memory(segment, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, 0, -1)
    file = os.fstat(segment.fd)
    nothing = os.open(os.devnull, os.O_RDONLY)
    # Besides `segment.fd`, Python's `mmap` object has a descriptor of the segment.
    for fd in [int(entry.name) for entry in Path("/proc/self/fd").iterdir()]:
        with suppress(OSError):
            if os.path.samestat(os.fstat(fd), file):
                os.dup2(nothing, fd)
    os.close(nothing)


def switch_segment(segment: Segment, rack: str) -> None:
    """Make the views of `segment` refer to the segment of another rack with the same layout.

    The caller must take its locks and claim its mailboxes again.
    """
    fd = os.open(get_shm_path(rack), os.O_RDWR)
    segment.rack = rack
    os.dup2(fd, segment.fd)
    os.close(fd)
    _map_memory(segment, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, segment.fd)
    byte_lock.reopen_all(segment.fd)


def _map_memory(segment: Segment, flags: int, rights: int, fd: int) -> None:
    """Map a file, or anonymous memory if `fd` is -1, in place of a segment's memory."""
    place = ctypes.addressof(ctypes.c_char.from_buffer(segment.bytes))
    if _libc.mmap(place, segment.map.size, rights, flags | _MAP_FIXED, fd, 0) != place:
        raise OSError(ctypes.get_errno(), "the memory of a segment cannot be mapped")
