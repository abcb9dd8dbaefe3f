"""The backplane's memory: one POSIX shared-memory segment a rack.

The Rack makes and unlinks it; everyone else attaches by the rack's name and finds the layout and
the resolved config in the segment itself.
"""

from __future__ import annotations

import json
import mmap
import os
import time
from dataclasses import asdict
from typing import Self

import posix_ipc

from backplane.address_map import AddressMap, pages
from backplane.errors import SegmentError
from backplane.layout import FieldSpec, Layout, MailboxSpec, TaskSpec
from backplane.process import is_alive, start_time
from backplane.words import Block, Head, System

MAGIC = int.from_bytes(b"NASREM-1", "little")
VERSION = 1
PREFIX = "nasrem-rack."
SHM_FOLDER = "/dev/shm"


def shm_name(rack: str) -> str:
    """Return the POSIX name of a rack's segment."""
    return f"/{PREFIX}{rack}"


class Segment:
    """An attached segment: `layout`, `config` (TOML text), `map`, and its memory as `words` and `bytes`."""

    def __init__(self, rack: str, shm: posix_ipc.SharedMemory) -> None:
        self.rack = rack
        self.fd = shm.fd
        self._map = mmap.mmap(shm.fd, shm.size)
        self.bytes = memoryview(self._map)
        self.words = self.bytes.cast("q")
        self.layout: Layout
        self.config: str
        self.map: AddressMap

    @classmethod
    def create(cls, layout: Layout, config: str) -> Self:
        """Make the segment of a rack, mode 0600, all of it allocated.

        Raises `SegmentError` when the name is in use or the memory does not suffice.
        """
        texts = [json.dumps(asdict(layout)).encode(), config.encode()]
        places = AddressMap(layout)
        size = pages(places.size + sum(len(t) for t in texts))
        name = shm_name(layout.rack)
        try:
            shm = posix_ipc.SharedMemory(name, posix_ipc.O_CREX, mode=0o600, size=size)
        except posix_ipc.ExistentialError:
            raise SegmentError(_in_use(layout.rack)) from None
        try:
            # A full /dev/shm would otherwise show as SIGBUS at the first touch of a page.
            os.posix_fallocate(shm.fd, 0, size)
        except OSError as error:
            os.close(shm.fd)
            posix_ipc.unlink_shared_memory(name)
            raise SegmentError(f"rack '{layout.rack}': {size} bytes of shared memory: {error.strerror}") from None
        segment = cls(layout.rack, shm)
        segment.layout, segment.config, segment.map = layout, config, places
        segment._fill_head(texts)
        return segment

    def _fill_head(self, texts: list[bytes]) -> None:
        address = self.map.size
        for at, text in zip((Head.LAYOUT_AT, Head.CONFIG_AT), texts, strict=True):
            self.words[at], self.words[at + 1] = address, len(text)
            self.bytes[address : address + len(text)] = text
            address += len(text)
        for task in self.layout.tasks:
            block = self.block(task.name)
            block[Block.RELEASED] = block[Block.DONE] = -1
            self.words[System.SYSFAIL + task.slot] = 1
        self.words[Head.VERSION] = VERSION
        self.words[Head.SIZE] = len(self.bytes)
        self.words[Head.LAUNCHER_PID] = os.getpid()
        self.words[Head.LAUNCHER_START] = start_time(os.getpid())
        self.words[Head.CREATED_NS] = time.time_ns()
        # Last, so that nobody attaches to half a segment.
        self.words[Head.MAGIC] = MAGIC

    @classmethod
    def attach(cls, rack: str) -> Self:
        """Attach to a rack's segment.

        Raises `SegmentError` when there is none, or its owner, size or version is not what it must be.
        """
        try:
            shm = posix_ipc.SharedMemory(shm_name(rack))
        except (posix_ipc.ExistentialError, posix_ipc.PermissionsError, ValueError) as error:
            running = ", ".join(racks()) or "none"
            why = "belongs to another user" if isinstance(error, posix_ipc.PermissionsError) else "is not there"
            raise SegmentError(f"rack '{rack}' {why}; racks: {running}") from None
        owner, least = os.fstat(shm.fd).st_uid, max(Head) * 8 + 8
        if os.getuid() not in (owner, 0) or shm.size < least:
            os.close(shm.fd)
            raise SegmentError(f"rack '{rack}': owner {owner}, {shm.size} bytes: not a segment of this user's")
        segment = cls(rack, shm)
        segment._read_head(shm.size)
        return segment

    def _read_head(self, size: int) -> None:
        if self.words[Head.MAGIC] != MAGIC or self.words[Head.VERSION] != VERSION:
            raise SegmentError(
                f"rack '{self.rack}': layout version {self.words[Head.VERSION]}; this program attaches to {VERSION}"
            )
        if self.words[Head.SIZE] != size:
            raise SegmentError(f"rack '{self.rack}': {size} bytes; its head says {self.words[Head.SIZE]}")
        self.layout = _layout(json.loads(self._text(Head.LAYOUT_AT)))
        self.config = self._text(Head.CONFIG_AT)
        self.map = AddressMap(self.layout)

    def _text(self, at: int) -> str:
        start = self.words[at]
        return bytes(self.bytes[start : start + self.words[at + 1]]).decode()

    def view(self, address: int, size: int) -> memoryview:
        """Return the bytes at a bus address."""
        return self.bytes[address : address + size]

    def block(self, task: str) -> memoryview:
        """Return a task's control block, as words (`words.Block`). Raises `KeyError`."""
        start = self.map.blocks[task] // 8
        return self.words[start : start + max(Block) + 1]

    @property
    def launcher(self) -> int:
        """Process id of the program that made the segment."""
        return self.words[Head.LAUNCHER_PID]

    @property
    def launcher_is_alive(self) -> bool:
        """Whether the process that made the segment still runs."""
        return is_alive(self.words[Head.LAUNCHER_PID], self.words[Head.LAUNCHER_START])

    def close(self) -> None:
        """Give the file descriptor back; the mapping goes with the last view on it."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def racks() -> list[str]:
    """Return the names of the racks that have a segment, whether they run or not."""
    return sorted(n.removeprefix(PREFIX) for n in os.listdir(SHM_FOLDER) if n.startswith(PREFIX))


def unlink(rack: str) -> None:
    """Remove a rack's segment by name; no error when it is gone already."""
    try:
        posix_ipc.unlink_shared_memory(shm_name(rack))
    except posix_ipc.ExistentialError:
        return


def _in_use(rack: str) -> str:
    return f"rack '{rack}' has a segment already: it runs, or was killed; see 'rack list', 'rack clean'"


def _field(entry: dict) -> FieldSpec:
    shape, fields = tuple(entry["shape"]), tuple(_field(f) for f in entry["fields"])
    return FieldSpec(**{**entry, "shape": shape, "fields": fields})


def _layout(entry: dict) -> Layout:
    boxes = [
        MailboxSpec(**{**m, "readers": tuple(m["readers"]), "fields": tuple(_field(f) for f in m["fields"])})
        for m in entry["mailboxes"]
    ]
    tasks = tuple(TaskSpec(**t) for t in entry["tasks"])
    return Layout(**{**entry, "tasks": tasks, "mailboxes": tuple(boxes)})
