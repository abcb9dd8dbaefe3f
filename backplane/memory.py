"""Memory of a real-time process, prepared so that no cycle waits for a page.

A board is forked from the crate and shares its memory. Without preparation, the first write to each
page copies it, the first access to each page of the segment or of a library maps it, and the C
library returns freed memory to the kernel only to request it again. That is a page fault in every
second cycle for the first seconds, and in rare code paths at any later time.

`mlockall` without MCL_ONFAULT would do all this in one call, but it would also fill memory that is
reserved and never used, which is twice the memory that a board needs. So pages are locked when they
are first touched. This module touches the pages of the process that are in use, the pages of files
that the crate has used, and the whole segment.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

_libc = ctypes.CDLL(None, use_errno=True)
_libc.madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_MCL_ONFAULT = 4
# MADV_* flags since Linux 5.14. On older kernels the first cycles touch the pages.
_POPULATE_READ = 22
_POPULATE_WRITE = 23
_M_TRIM_THRESHOLD = -1
_M_MMAP_MAX = -4
HEAP_RESERVE = 4 << 20
"""Free heap that the C library holds in reserve, in bytes."""
MAX_GAP_PAGES = 16
"""Longest gap of unused pages that is touched together with the used pages around it.

A separate call for each stretch would take longer.
"""
_USER_END = 1 << 63
"""First address of the kernel, which owns mappings such as [vsyscall]."""
_PRESENT = 63
"""Bit of an entry of /proc/self/pagemap that is set if the page is in memory."""


def hold_memory(lockstep: bool) -> None:
    """Disable the garbage collector, and have the kernel lock each page when it is touched.

    In lockstep no memory is locked: locking takes a sixth of the launch time, and page faults do
    not affect the result.
    """
    if not lockstep:
        _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    gc.freeze()
    gc.disable()


_FILES: list[tuple[int, int]] = []
"""Start and end addresses of the parts of mapped files that the crate has used."""


def record_used_files() -> None:
    """Record which pages of mapped files this process has in memory.

    A fork does not inherit the page table entries of mapped files, so `touch_memory` uses this
    record to map the pages again in a forked board.
    """
    _FILES[:] = [
        stretch
        for _, rights, pages in _iterate_mappings()
        if rights[:2] == "r-"
        for stretch in pages
    ]


def touch_memory() -> None:
    """Touch every page that a cycle may need, and have the C library keep freed memory.

    This takes about a tenth of a second, mostly to copy pages that are shared with the crate.
    """
    _libc.mallopt(_M_TRIM_THRESHOLD, -1)
    _libc.mallopt(_M_MMAP_MAX, 0)
    reserve = ctypes.create_string_buffer(HEAP_RESERVE)
    del reserve
    for span, rights, stretches in _iterate_mappings():
        if rights == "rw-s":
            stretches = [span]  # all of the segment
        elif rights[1] != "w":
            continue
        for first, last in stretches:
            _libc.madvise(first, last - first, _POPULATE_WRITE)
    for first, last in _FILES:
        _libc.madvise(first, last - first, _POPULATE_READ)


def _iterate_mappings() -> Iterator[tuple[tuple[int, int], str, list[tuple[int, int]]]]:
    """Yield address range, access rights and resident ranges of every readable mapping."""
    with Path("/proc/self/pagemap").open("rb", buffering=0) as pagemap:
        for line in Path("/proc/self/maps").read_text().splitlines():
            addresses, rights, *_ = line.split(maxsplit=2)
            start, end = (int(address, 16) for address in addresses.split("-"))
            if rights[0] == "r" and start < _USER_END:
                yield (start, end), rights, list(_iterate_resident(pagemap.fileno(), start, end))


def _iterate_resident(pagemap: int, start: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield the start and end address of each resident range of a mapping.

    Ranges separated by a short gap (`MAX_GAP_PAGES`) are joined.

    Args:
        pagemap: Descriptor of /proc/self/pagemap.
        start: First address of the mapping.
        end: First address after the mapping.
    """
    page = mmap.PAGESIZE
    entries = np.frombuffer(os.pread(pagemap, (end - start) // page * 8, start // page * 8), "u8")
    pages = np.flatnonzero(entries >> _PRESENT)
    if not len(pages):
        return
    breaks = np.flatnonzero(np.diff(pages) > MAX_GAP_PAGES)
    firsts = pages[np.append(0, breaks + 1)]
    lasts = pages[np.append(breaks, len(pages) - 1)] + 1
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        yield start + first * page, start + last * page
