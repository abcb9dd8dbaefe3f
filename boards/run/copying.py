"""Copies of a process, forked between two of its cycles: each waits until a rack goes on from it.

A fork has all that a process knows, whatever it consists of. What it shares with the process that
it is forked from, it gets for itself: files that are open for reading are opened again where they
were read last. What cannot be had twice is refused: files open for writing, sockets, threads.

A copy that is to go on forks its successor, which waits as it did, and goes on itself. The crate is
its parent by then, since the board that it was forked from has ended. A copy waits on a line
whose other end only the crate holds: it ends when the crate does.
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
from rack.backplane.mailbox.mailbox import claim_again
from rack.backplane.process import COPY, die_with_parent, name_process
from rack.backplane.segment import Segment
from rack.boards.errors import SnapshotError
from rack.levels.level import LevelContext

MOST_BYTES = 4096
"""Largest note of a board."""
MOST_FILES = 2
_DESCRIPTORS = Path("/proc/self/fd")
_THREADS = Path("/proc/self/task")


@dataclass(frozen=True)
class CopyNote:
    """A board's note to the crate: the process `pid` is a copy of it before `tick`, and waits.

    With it come the crate's end of its line and, from the clock, the memory of the segment. The
    successor of a copy that goes on has its line already.
    """

    tick: int
    name: str
    pid: int

    def send(self, line: socket, *files: int) -> None:
        """Send it with open files. Raises `OSError` when the crate is gone."""
        send_fds(line, [encode_json(asdict(self)).encode()], files)


def receive_note(line: socket) -> tuple[CopyNote, list[int]]:
    """Return the next note, and the files that came with it."""
    data, files, *_ = recv_fds(line, MOST_BYTES, MOST_FILES)
    return CopyNote(**json.loads(data)), files


@dataclass(frozen=True)
class GoOn:
    """The crate's request to a copy: go on in the segment of `rack`, as a child of the crate, with
    another `context` of the level if there is one.

    The other request, None, is answered with the attributes of the level as JSON.
    """

    crate: int
    rack: str
    context: LevelContext | None


class Copier:
    """Forks copies of this process.

    Make it before the level: what is open by then is not the level's.
    """

    def __init__(self, segment: Segment, name: str, line: socket) -> None:
        self._segment = segment
        self._name = name
        self._line = line
        self._before = _open_files()
        self._copies: list[int] = []

    def copy(
        self, tick: int, *memory: int, show: Callable[[], Mapping[str, Any]] = dict
    ) -> GoOn | None:
        """Fork a copy before `tick`.

        Args:
            tick: The tick that the copy begins with.
            memory: Of the clock, the file with the segment's memory.
            show: Returns the attributes of the level that the copy shows.

        Returns:
            None in this process. In a copy, as often as a rack goes on from it, the request.

        Raises:
            SnapshotError: The process cannot be copied, with the reason.
        """
        if why := "; ".join(self._refused(memory)):
            raise SnapshotError(f"{self._name}: {why}")
        offsets = {
            fd: os.lseek(fd, 0, os.SEEK_CUR)
            for fd in _open_files()
            if _is_only_read(fd) and stat.S_ISREG(os.fstat(fd).st_mode)
        }
        seeds = random.getstate()
        here, theirs = Pipe()
        with here, theirs:
            try:
                pid = os.fork()
            except OSError as error:
                raise SnapshotError(f"{self._name}: no copy: {error.strerror}") from None
            if pid:
                CopyNote(tick, self._name, pid).send(self._line, here.fileno(), *memory)
                # Those that have ended since: they are this process's children.
                self._copies = [one for one in self._copies if not os.waitpid(one, os.WNOHANG)[0]]
                self._copies.append(pid)
                return None
            here.close()
            copies.leave(self._segment)
            name_process(f"{COPY}{self._name}")
            request, successor = self._await_request(theirs, offsets, seeds, show)
        die_with_parent(request.crate)
        copies.enter(self._segment, request.rack)
        claim_again()
        CopyNote(tick, self._name, successor).send(self._line)
        self._copies = [successor]
        name_process(f"{self._segment.rack}:{self._name}")
        return request

    def _await_request(
        self,
        crate: Connection,
        offsets: Mapping[int, int],
        seeds: Any,
        show: Callable[[], Mapping[str, Any]],
    ) -> tuple[GoOn, int]:
        """Wait until a rack goes on from here; return the request, and the process that waits from
        then on. End with the crate.
        """
        while True:
            for fd, offset in offsets.items():
                # Open the file for this process alone, and read it up to `offset`.
                again = os.open(f"/proc/self/fd/{fd}", os.O_RDONLY | os.O_CLOEXEC)
                os.lseek(again, offset, os.SEEK_SET)
                os.dup2(again, fd)
                os.close(again)
            # A fork gets new ones from Python.
            random.setstate(seeds)
            try:
                # From the crate's own process, as is all that a board is told when it is forked.
                request: GoOn | None = crate.recv()
                if request is None:
                    crate.send_bytes(encode_json(show()).encode())
                elif successor := os.fork():
                    return request, successor
            except (EOFError, OSError):
                # The crate is gone, or the system refuses a fork, as the crate notices.
                os._exit(os.EX_OSERR)

    def _refused(self, memory: Collection[int]) -> list[str]:
        """Return what the process has that no copy can have; `memory`: files that are the
        clock's.
        """
        segment = os.fstat(self._segment.fd)
        found = [
            f"it holds {name}"
            for fd, name in _open_files().items()
            if self._before.get(fd) != name
            and fd not in memory
            # A lock has the segment open, too.
            and not os.path.samestat(os.fstat(fd), segment)
            and not _is_only_read(fd)
        ]
        threads = [path for path in _THREADS.iterdir() if path.name != str(os.getpid())]
        return found + [
            f"it has the thread {(path / 'comm').read_text().strip()}" for path in threads
        ]


def _open_files() -> dict[int, str]:
    """Return the open files of this process, with what each is."""
    found = {}
    for entry in [*_DESCRIPTORS.iterdir()]:
        # That of the listing itself is gone.
        with suppress(FileNotFoundError):
            found[int(entry.name)] = str(entry.readlink())
    return found


def _is_only_read(fd: int) -> bool:
    """Say whether an open file is a regular file or a folder that is only read, or a device."""
    kind = os.fstat(fd).st_mode
    has_content = stat.S_ISREG(kind) or stat.S_ISDIR(kind)
    flags = fcntl(fd, F_GETFL)
    return stat.S_ISCHR(kind) or (has_content and flags & os.O_ACCMODE == os.O_RDONLY)
