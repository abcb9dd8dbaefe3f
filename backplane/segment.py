"""The backplane's memory: one POSIX shared-memory segment per rack.

The Rack creates and unlinks it. All other processes attach by the rack's name and find the layout
and the resolved config in the segment itself. The segment gets its name only when it is complete,
so a launcher killed earlier leaves nothing in /dev/shm, and no process finds half a segment.
"""

from __future__ import annotations

import json
import mmap
import os
import stat
import time
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, get_args, get_type_hints
from zlib import crc32

import posix_ipc

from rack.backplane.address_map import (
    BLOCK_SIZE,
    HEAD_SIZE,
    MAILBOX_HEAD_SIZE,
    AddressMap,
    round_up_to_pages,
)
from rack.backplane.byte_lock import ProcessLock, is_locked
from rack.backplane.errors import SegmentError
from rack.backplane.json_text import encode_json
from rack.backplane.layout import Layout, TaskSpec
from rack.backplane.semaphores import Semaphore
from rack.backplane.words import Block, Head, Run, System

if TYPE_CHECKING:
    from rack.backplane.message import Message

MAGIC = int.from_bytes(b"NASREM-1", "little")
VERSION = 19
TEXTS = (Head.LAYOUT_AT, Head.CONFIG_AT, Head.PUBLISHED_AT)
"""Words that contain the addresses of the texts. The word after each contains the size."""
PREFIX = "nasrem-rack."
SHM_FOLDER = Path("/dev/shm")
"""Folder in which the C library's `shm_open` keeps its names."""
POLL_S = 0.02
"""Time between two checks of the lock of a launcher that is about to end."""
_LAUNCHER_LOCK = 8 * Head.LAUNCHER_PID
"""Bus address on which the launcher holds a lock for as long as it lives."""
PROCESSOR = "x86_64"
"""Processor architecture on which stores become visible to other cores in program order.

Rings and control blocks need this order, and so do mailboxes where Python accesses them (see
`rack.backplane.mailbox.slots`). Racks have not been tested on other architectures.
"""


class Launch(NamedTuple):
    """Time at which a segment was created, in ns of the wall clock and of CLOCK_MONOTONIC."""

    created_ns: int
    monotonic_ns: int

    @property
    def wall_offset_ns(self) -> int:
        """Wall clock minus CLOCK_MONOTONIC, in ns.

        The offset is fixed for the whole run, because the wall clock may be set during the run.
        """
        return self.created_ns - self.monotonic_ns


class CycleCounts(NamedTuple):
    """Counts of a task's cycles.

    Attributes:
        missed: Number of plans or cycles that missed their deadline.
        skipped: Number of cycles that were skipped.
        due: Number of cycles that were due.
        plan: Number of cycles that one plan may take. 1 for an executor.
    """

    missed: int
    skipped: int
    due: int
    plan: int

    @property
    def lost(self) -> int:
        """Number of cycles that were missed or skipped.

        Every cycle of a missed plan is counted. If the plan ends after the last cycle that was due,
        the sum would exceed `due`, so it is limited to `due`.
        """
        return min(self.due, self.missed * self.plan + self.skipped)

    def __str__(self) -> str:
        """Return the counts as readable text."""
        unit = f" plans of {self.plan} cycles" * (self.plan > 1)
        return f"missed {self.missed}{unit} and skipped {self.skipped} of its {self.due} cycles"


class Segment:
    """Segment of a rack, mapped into this process.

    Attributes:
        layout: Mailboxes and tasks.
        config: The resolved config, as TOML.
        published: Published facts about the levels, as JSON.
        map: Bus addresses.
        words: The memory as 64-bit integers.
        bytes: The memory as bytes.
    """

    def __init__(self, rack: str, memory: mmap.mmap, fd: int = -1) -> None:
        self.rack = rack
        self.fd = fd
        self._life: ProcessLock | None = None
        self.bytes = memoryview(memory)
        self.words = self.bytes.cast("q")
        self.message_classes: dict[str, type[Message]] = {}
        """Message classes that this process reads and writes, by mailbox.

        `AnyMessage` is used for the other mailboxes.
        """
        self.layout: Layout
        self.config: str
        self.published: str
        self.map: AddressMap

    @classmethod
    def create(cls, layout: Layout, config: str, published: str = "{}") -> Self:
        """Create the segment of a rack with mode 0600, fully allocated.

        Args:
            layout: Layout of the backplane.
            config: The resolved config, as TOML.
            published: Published facts about the levels, as JSON.

        Raises:
            SegmentError: The name is in use, memory is short, or the processor is not
                supported.
        """
        if (machine := os.uname().machine) != PROCESSOR:
            raise SegmentError(
                f"rack '{layout.rack}': the processor here is {machine}, and the backplane's memory"
                f" order is proved for {PROCESSOR} alone"
            )
        texts = [encode_json(asdict(layout)).encode(), config.encode(), published.encode()]
        places = AddressMap(layout)
        size = round_up_to_pages(places.size + sum(len(t) for t in texts))
        try:
            fd = os.open(SHM_FOLDER, os.O_TMPFILE | os.O_RDWR, 0o600)
            life = ProcessLock(fd, _LAUNCHER_LOCK)
        except OSError as error:
            raise SegmentError(f"rack '{layout.rack}': {SHM_FOLDER}: {error.strerror}") from None
        try:
            # Allocate all pages now. Otherwise, with a full /dev/shm, the first access to a page
            # would raise SIGBUS.
            os.posix_fallocate(fd, 0, size)
            segment = cls(layout.rack, mmap.mmap(fd, size), fd)
            segment.layout = layout
            segment.config = config
            segment.published = published
            segment.map = places
            segment._fill_head(texts)
            segment._life = life
            # Take the lock before the segment has a name, so that no process ever finds the segment
            # of a live rack without it.
            life.take()
            # The paths are absolute, but only with a directory descriptor does Python follow the
            # symbolic link in /proc. Without one, it would link to the symbolic link itself.
            os.link(f"/proc/self/fd/{fd}", get_shm_path(layout.rack), src_dir_fd=fd)
        except OSError as error:
            os.close(fd)
            life.close()
            if isinstance(error, FileExistsError):
                raise SegmentError(
                    f"rack '{layout.rack}' already has a segment: it is running, or was killed;"
                    " see 'rack list' and 'rack clean'"
                ) from None
            space = os.statvfs(SHM_FOLDER)
            raise SegmentError(
                f"rack '{layout.rack}': {size} bytes of shared memory: {error.strerror}:"
                f" {SHM_FOLDER} has {space.f_blocks * space.f_frsize} bytes,"
                f" {space.f_bavail * space.f_frsize} of them free; for a container, --shm-size"
                " sets its size"
            ) from None
        return segment

    def _fill_head(self, texts: list[bytes]) -> None:
        """Fill the head of a new segment, its texts, and the words that do not start at 0.

        Args:
            texts: Layout, config and published facts.
        """
        address = self.map.size
        self.words[Head.CHECK] = crc32(b"".join(texts))
        for at, text in zip(TEXTS, texts, strict=True):
            self.words[at] = address
            self.words[at + 1] = len(text)
            self.bytes[address : address + len(text)] = text
            address += len(text)
        for process in self.layout.processes:
            block = self.get_block(process.name)
            block[Block.RELEASED] = block[Block.DONE] = -1
        for task in self.layout.tasks:
            self.words[System.SYSFAIL + task.slot] = 1
        self.initialize_semaphores()
        self.words[Head.VERSION] = VERSION
        self.words[Head.SIZE] = len(self.bytes)
        self.words[Head.LAUNCHER_PID] = os.getpid()
        self.words[Head.LAUNCHER_NAMESPACE] = _pid_namespace()
        self.words[Head.CREATED_NS] = time.time_ns()
        self.words[Head.CREATED_MONOTONIC_NS] = time.monotonic_ns()
        # This is stored last, so that no process attaches to an incomplete segment.
        self.words[Head.MAGIC] = MAGIC

    def initialize_semaphores(self) -> None:
        """Initialize all semaphores. No process may be waiting on them."""
        places = self.map
        values = {0: (*places.wake.values(), *places.done.values()), 1: places.locks.values()}
        for value, addresses in values.items():
            for address in addresses:
                Semaphore(self.bytes, address).initialize(value)

    @classmethod
    def attach(cls, rack: str) -> Self:
        """Map a rack's segment into this process, and read its layout and config.

        Raises:
            SegmentError: There is no such segment, or its owner, size or version is wrong.
        """
        segment = cls.open(rack)
        try:
            segment.read_head()
        except SegmentError:
            segment.close()
            raise
        return segment

    @classmethod
    def open(cls, rack: str) -> Self:
        """Open a rack's segment of any version, without reading its layout and config.

        Only properties that need no layout, such as `launcher`, can be used on the result.

        Raises:
            SegmentError: There is no such segment, it belongs to another user, or it is not a
                segment.
        """
        if (kind := find_foreign_kind(rack)) is not None:
            raise SegmentError(f"rack '{rack}': {get_shm_path(rack)} is a {kind}, not a segment")
        try:
            # `posix_ipc` expects a leading slash.
            shm = posix_ipc.SharedMemory(f"/{PREFIX}{rack}")
        except (posix_ipc.ExistentialError, posix_ipc.PermissionsError, ValueError) as error:
            why = (
                "belongs to another user"
                if isinstance(error, posix_ipc.PermissionsError)
                else "does not exist"
            )
            raise SegmentError(
                f"rack '{rack}' {why}; racks: {', '.join(list_racks()) or 'none'}"
            ) from None
        status = os.fstat(shm.fd)
        if os.getuid() not in (status.st_uid, 0) or status.st_size < HEAD_SIZE:
            os.close(shm.fd)
            raise SegmentError(
                f"rack '{rack}': owner {status.st_uid}, {status.st_size} bytes: not a segment of"
                " this user"
            )
        return cls(rack, mmap.mmap(shm.fd, status.st_size), shm.fd)

    def read_head(self) -> None:
        """Read layout, config and published facts from the segment.

        Raises:
            SegmentError: Size or version is wrong, or a text is damaged.
        """
        if self.words[Head.MAGIC] != MAGIC or self.words[Head.VERSION] != VERSION:
            raise SegmentError(
                f"rack '{self.rack}': layout version {self.words[Head.VERSION]}; this program"
                f" attaches to {VERSION}"
            )
        if self.words[Head.SIZE] != len(self.bytes):
            raise SegmentError(
                f"rack '{self.rack}': the segment has {len(self.bytes)} bytes, but its head says"
                f" {self.words[Head.SIZE]}"
            )
        try:
            places = [self.words[at : at + 2] for at in TEXTS]
            texts = [bytes(self.bytes[start : start + size]) for start, size in places]
            if crc32(b"".join(texts)) != self.words[Head.CHECK]:
                raise ValueError("the texts in its head are damaged")
            layout, self.config, self.published = (text.decode() for text in texts)
            self.layout = restore_layout(json.loads(layout))
            self.map = AddressMap(self.layout)
            if self.map.size != self.words[Head.LAYOUT_AT]:
                raise ValueError(f"the layout cannot have {self.map.size} bytes")
        except (TypeError, LookupError, ValueError, AttributeError, RecursionError) as error:
            raise SegmentError(
                f"rack '{self.rack}': the layout is damaged or from another program: {error}"
            ) from None

    def get_bytes(self, address: int, size: int) -> memoryview:
        """Return a view of `size` bytes at a bus address."""
        return self.bytes[address : address + size]

    def get_block(self, task: str) -> memoryview:
        """Return a view of a task's control block, with the words of `words.Block`.

        Raises:
            KeyError: There is no such task.
        """
        start = self.map.blocks[task] // 8
        return self.words[start : start + BLOCK_SIZE // 8]

    def count_cycles(self, task: TaskSpec, tick: int) -> CycleCounts:
        """Count the cycles of a task up to `tick`.

        A release that the task has not finished is counted as skipped once its time slice is over,
        but not while a plan that was begun in it is still in time.
        """
        block = self.get_block(task.name)
        skipped = block[Block.SKIPPED]
        if block[Block.DEADLINE] <= max(tick, block[Block.RELEASED] + task.every):
            skipped += task.count_unfinished(block[Block.DONE], tick)
        return CycleCounts(
            block[Block.MISSED], skipped, task.count_unfinished(-1, tick), task.within_cycles
        )

    def get_box(self, mailbox: str) -> memoryview:
        """Return a view of the head of a mailbox, with the words of `words.Box`.

        Raises:
            KeyError: There is no such mailbox.
        """
        start = self.map.mailboxes[mailbox] // 8
        return self.words[start : start + MAILBOX_HEAD_SIZE // 8]

    def is_locked(self, address: int) -> bool:
        """Check whether a process holds the lock on the byte at a bus address.

        See `rack.backplane.byte_lock`.
        """
        return is_locked(self.fd, address)

    @property
    def launch(self) -> Launch:
        """Time of the rack's launch, at which the segment was created."""
        return Launch(self.words[Head.CREATED_NS], self.words[Head.CREATED_MONOTONIC_NS])

    @property
    def launcher(self) -> int:
        """Process id of the program that created the segment.

        It is 0 if that program has another PID namespace, as in another container. The number would
        refer to a different process in this namespace.
        """
        is_here = self.words[Head.LAUNCHER_NAMESPACE] == _pid_namespace()
        return self.words[Head.LAUNCHER_PID] if is_here else 0

    @property
    def launcher_text(self) -> str:
        """Description of the launcher for error messages, such as "process 12"."""
        return f"process {self.launcher}" if self.launcher else "a process of another PID namespace"

    @property
    def launcher_is_alive(self) -> bool:
        """True if the process that created the segment is still running."""
        return self.is_locked(_LAUNCHER_LOCK)

    def await_launcher(self, timeout_s: float) -> bool:
        """Wait until the launcher has ended or closed its segment. Returns False on timeout."""
        deadline = time.monotonic() + timeout_s
        while self.launcher_is_alive:
            if time.monotonic() >= deadline:
                return False
            time.sleep(POLL_S)
        return True

    @property
    def tick(self) -> int:
        """The newest tick of the clock."""
        return self.words[System.TICK]

    @property
    def run_is_over(self) -> bool:
        """True if the run has ended normally, or the launcher has ended."""
        return self.words[System.STATE] == Run.STOPPED or not self.launcher_is_alive

    @property
    def is_named(self) -> bool:
        """True if this is still the segment with the rack's name.

        False if the segment was unlinked, or if the rack has been launched again since.
        """
        try:
            named = get_shm_path(self.rack).stat()
        except FileNotFoundError:
            return False
        return os.path.samestat(named, os.fstat(self.fd))

    def release_launcher_lock(self) -> None:
        """Release the launcher's lock if this process holds it. Others then find the rack dead."""
        if self._life is not None:
            self._life.close()

    def close(self) -> None:
        """Close the file descriptor, and release the launcher's lock.

        The mapping lasts as long as there are views of it.
        """
        self.release_launcher_lock()
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


def list_racks() -> list[str]:
    """Return the names of the racks that have a segment, whether they are running or not."""
    return sorted(path.name.removeprefix(PREFIX) for path in SHM_FOLDER.glob(f"{PREFIX}*"))


def find_foreign_kind(rack: str) -> str | None:
    """Return the kind of an entry in /dev/shm that has a rack's name but is not a segment.

    Returns:
        The kind, such as "directory". None if the entry is a regular file or does not exist.
    """
    try:
        mode = get_shm_path(rack).lstat().st_mode
    except OSError:  # no such file, or an impossible name
        return None
    kinds = {stat.S_IFDIR: "directory", stat.S_IFLNK: "symbolic link"}
    return None if stat.S_ISREG(mode) else kinds.get(stat.S_IFMT(mode), "special file")


def unlink_segment(rack: str) -> None:
    """Remove a rack's segment by name. Does nothing if the segment does not exist.

    Raises:
        SegmentError: The segment belongs to another user.
    """
    try:
        posix_ipc.unlink_shared_memory(f"/{PREFIX}{rack}")
    except posix_ipc.ExistentialError:
        return
    except posix_ipc.PermissionsError:
        raise SegmentError(
            f"rack '{rack}' belongs to another user: only that user may remove it"
        ) from None


def get_shm_path(rack: str) -> Path:
    """Return the path of a rack's segment in /dev/shm."""
    return SHM_FOLDER / f"{PREFIX}{rack}"


def _pid_namespace() -> int:
    """Return the inode of this process's PID namespace, which identifies the namespace."""
    return Path("/proc/self/ns/pid").stat().st_ino


def restore_layout(plain: dict[str, Any]) -> Layout:
    """Restore a layout from plain data made by `dataclasses.asdict`.

    Fields that are missing, as in recordings of earlier versions, get their defaults.
    """
    layout: Layout = _restore_value(Layout, plain)
    return layout


def _restore_value(kind: Any, plain: Any) -> Any:
    """Convert plain data recursively: dictionaries to dataclasses, and lists to tuples.

    Args:
        kind: Annotated type of the result.
        plain: Data as parsed from JSON.
    """
    if isinstance(plain, list):
        inner, *_ = get_args(kind)
        return tuple([_restore_value(inner, entry) for entry in plain])
    if isinstance(plain, dict):
        # The first argument of an optional type is the type that is not None.
        record, *_ = get_args(kind) or (kind,)
        types = _get_types(record)
        return record(**{name: _restore_value(types[name], entry) for name, entry in plain.items()})
    return plain


_get_types = cache(get_type_hints)
