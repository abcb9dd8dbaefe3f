"""Copies of a process, forked between two of its cycles, from which a rack can continue later.

A fork has the whole state of the process. Files that it would share with its parent are separated:
if they are open for reading, the copy opens them again at the same position. A process cannot be
copied if it has resources that cannot be duplicated: files open for writing, sockets or threads.

A copy that is requested to continue first forks a successor, which waits in its place for further
requests. Only then does it continue. By that time its parent is the crate, because the board from
which it was forked has ended. A copy waits on a pipe whose other end only the crate has open, so it
ends when the crate ends.
"""

from __future__ import annotations

import json
import os
import random
import stat
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from fcntl import F_GETFL, fcntl
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from socket import recv_fds, send_fds, socket
from typing import Any

from rack.backplane import copies
from rack.backplane.json_text import encode_json
from rack.backplane.mailbox.claim import reclaim_mailboxes
from rack.backplane.process import COPY_PREFIX, die_with_parent, name_process
from rack.backplane.segment import Segment
from rack.boards.errors import SnapshotError
from rack.levels.level import LevelContext

MAX_NOTE_BYTES = 4096
"""Maximum size of a `CopyMessage` as JSON."""
MAX_NOTE_FILES = 2
"""Maximum number of descriptors sent with a `CopyMessage`."""
ReadAttributes = Callable[[], Mapping[str, Any]]
"""Returns the attributes of a level."""


@dataclass(frozen=True)
class CopyMessage:
    """Message to the crate that a copy of a task or of the clock exists and waits for requests.

    The crate's end of the copy's pipe is sent with the message. The clock also sends the file with
    the segment's memory. If the copy replaces one that has continued, it uses that copy's pipe, and
    no pipe is sent.

    Attributes:
        tick: First tick that the copy will run.
        name: Name of the task, or of the clock.
        pid: Process id of the copy.
    """

    tick: int
    name: str
    pid: int

    def send(self, line: socket, *files: int) -> None:
        """Send the message and the descriptors of open files.

        Args:
            line: Socket to the crate.
            files: Descriptors to send along.

        Raises:
            OSError: The crate has ended.
        """
        send_fds(line, [encode_json(asdict(self)).encode()], files)


def receive_copy_message(line: socket) -> tuple[CopyMessage, list[int]]:
    """Wait for the next `CopyMessage`. Returns it with the descriptors that were sent along."""
    data, files, *_ = recv_fds(line, MAX_NOTE_BYTES, MAX_NOTE_FILES)
    return CopyMessage(**json.loads(data)), files


@dataclass(frozen=True)
class ContinueRequest:
    """Request from the crate to a copy, to continue in the segment of another rack.

    Instead of this request the crate may send None. The copy then answers with the attributes of
    its level as JSON, and waits for the next request.

    Attributes:
        crate: Process id of the crate, which is the parent of the copy.
        rack: Name of the rack.
        context: New context of the level. None to leave it unchanged.
    """

    crate: int
    rack: str
    context: LevelContext | None


class Copier:
    """Forks copies of this process.

    Create it before the level. Files that are already open at that time do not prevent a copy.
    """

    def __init__(self, segment: Segment, name: str, line: socket) -> None:
        self._segment = segment
        self._name = name
        self._line = line
        self._before = _list_open_files()
        self._copies: list[int] = []

    def fork_copy(
        self, tick: int, *memory: int, show: ReadAttributes = dict
    ) -> ContinueRequest | None:
        """Fork a copy of this process. The copy waits in this call until a rack continues from it.

        Args:
            tick: First tick that the copy will run.
            memory: For the clock, the file with the segment's memory.
            show: Returns the attributes of the level, which the copy sends on request.

        Returns:
            None in this process. In a copy, the request to continue.

        Raises:
            SnapshotError: The process cannot be copied. The error states the reason.
        """
        if why := "; ".join(self._list_obstacles(memory)):
            raise SnapshotError(f"{self._name}: {why}")
        offsets = {
            fd: os.lseek(fd, 0, os.SEEK_CUR)
            for fd in _list_open_files()
            if _is_read_only(fd) and stat.S_ISREG(os.fstat(fd).st_mode)
        }
        seeds = random.getstate()
        here, theirs = Pipe()
        own_name = f"{self._segment.rack}:{self._name}"
        with here, theirs:
            # The copy inherits the name, so that nobody takes it for a board before it has run.
            name_process(f"{COPY_PREFIX}{self._name}")
            try:
                pid = os.fork()
            except OSError as error:
                name_process(own_name)
                raise SnapshotError(f"{self._name}: cannot be copied: {error.strerror}") from None
            if pid:
                name_process(own_name)
                CopyMessage(tick, self._name, pid).send(self._line, here.fileno(), *memory)
                # Reap earlier copies that have ended, because they are children of this process.
                self._copies = [
                    copy for copy in self._copies if not os.waitpid(copy, os.WNOHANG)[0]
                ]
                self._copies.append(pid)
                return None
            here.close()
            copies.detach_segment(self._segment)
            request, successor = self._await_request(theirs, offsets, seeds, show)
        die_with_parent(request.crate)
        copies.switch_segment(self._segment, request.rack)
        reclaim_mailboxes()
        CopyMessage(tick, self._name, successor).send(self._line)
        self._copies = [successor]
        name_process(f"{self._segment.rack}:{self._name}")
        return request

    def _await_request(
        self, crate: Connection, offsets: Mapping[int, int], seeds: Any, show: ReadAttributes
    ) -> tuple[ContinueRequest, int]:
        """In a copy, wait for the request to continue. Answer requests for attributes until then.

        If the crate ends first, the process exits.

        Args:
            crate: Pipe to the crate.
            offsets: A dictionary from descriptor to position, for the files open for reading.
            seeds: State of Python's random number generator.
            show: Returns the attributes of the level.

        Returns:
            The request, and the process id of the successor that waits for further requests.
        """
        while True:
            for fd, offset in offsets.items():
                # Open the file again, so that its position is not shared with other processes.
                reopened = os.open(f"/proc/self/fd/{fd}", os.O_RDONLY | os.O_CLOEXEC)
                os.lseek(reopened, offset, os.SEEK_SET)
                os.dup2(reopened, fd)
                os.close(reopened)
            # Python reseeds its random number generator in a forked process.
            random.setstate(seeds)
            try:
                # The request is trusted, because it comes from the crate.
                request: ContinueRequest | None = crate.recv()
                if request is None:
                    _show_attributes(crate, show)
                elif successor := os.fork():
                    return request, successor
            except (EOFError, OSError):
                # The crate has ended, or the system refuses a fork, which the crate notices.
                os._exit(os.EX_OSERR)

    def _list_obstacles(self, memory: Collection[int]) -> list[str]:
        """Describe each resource of this process that prevents a copy.

        Args:
            memory: Files to ignore, because they are sent to the crate with the copy.
        """
        segment = os.fstat(self._segment.fd)
        resources = [
            f"it holds {name}"
            for fd, name in _list_open_files().items()
            if self._before.get(fd) != name
            and fd not in memory
            # Locks hold descriptors of the segment, too.
            and not os.path.samestat(os.fstat(fd), segment)
            and not _is_read_only(fd)
        ]
        threads = [
            path for path in Path("/proc/self/task").iterdir() if path.name != str(os.getpid())
        ]
        return resources + [
            f"it runs the thread {(path / 'comm').read_text().strip()}" for path in threads
        ]


def _show_attributes(crate: Connection, show: ReadAttributes) -> None:
    """Send the attributes of a level to the crate, or an empty text after an error.

    A child process reads them, so that the state of this process does not change.
    """
    if child := os.fork():
        os.waitpid(child, 0)
        return
    text = ""
    try:
        text = encode_json(show())
    finally:
        crate.send_bytes(text.encode())
        os._exit(os.EX_OK)


def _list_open_files() -> dict[int, str]:
    """Return a dictionary from descriptor to file name, for the open files of this process."""
    name_by_descriptor = {}
    for entry in [*Path("/proc/self/fd").iterdir()]:
        # The descriptor of the listing itself is closed by now.
        with suppress(FileNotFoundError):
            name_by_descriptor[int(entry.name)] = str(entry.readlink())
    return name_by_descriptor


def _is_read_only(fd: int) -> bool:
    """Check whether an open file is a device, or a file or folder open only for reading."""
    kind = os.fstat(fd).st_mode
    has_content = stat.S_ISREG(kind) or stat.S_ISDIR(kind)
    flags = fcntl(fd, F_GETFL)
    return stat.S_ISCHR(kind) or (has_content and flags & os.O_ACCMODE == os.O_RDONLY)
