"""The snapshots that a crate holds: of each process of a rack a copy that waits, and the memory of
the segment.

They are bounded in number and in memory, and thinned out with age: of the older half, the one goes
that leaves the smallest gap. A snapshot of which a copy is lost goes whole. All end with the crate:
it holds the only other end of each copy's socket.
"""

from __future__ import annotations

import os
import pickle
import re
import signal
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from socket import AF_UNIX, SOCK_SEQPACKET, socket, socketpair
from tempfile import TemporaryFile

from rack.backplane.process import readable
from rack.backplane.segment import SHM_FOLDER
from rack.boards.run.copying import CopyNote, CopyRequest, receive, send
from rack.boards.wiring import ClockWiring, TaskWiring

MOST_SNAPSHOTS = 32
MEMORY_PART = 4
"""Snapshots have at most one part in so many of the machine's memory."""
SHOW_S = 10.0
"""Longest wait for a copy that shows its level."""
Wiring = TaskWiring | ClockWiring


@dataclass
class WaitingCopy:
    """A copy of one process. `pid`: 0 while its successor is not known."""

    wiring: Wiring
    control: socket
    pid: int


@dataclass
class HeldSnapshot:
    """The copies of all processes of a rack before `tick`, by name, and its memory, a file.

    `private_bytes`: the memory that it has for itself, when it was last measured.
    """

    tick: int
    copies: dict[str, WaitingCopy] = field(default_factory=dict)
    memory: int = -1
    private_bytes: int = 0

    def measure(self) -> None:
        """Measure the memory that it has for itself."""
        self.private_bytes = os.fstat(self.memory).st_size
        for copy in self.copies.values():
            with suppress(OSError):
                text = Path(f"/proc/{copy.pid}/smaps_rollup").read_text()
                found = re.findall(r"Private_Dirty: +(\d+)", text)
                self.private_bytes += sum(int(kib) << 10 for kib in found)

    def close(self) -> None:
        """Let go of it in this process."""
        for copy in self.copies.values():
            copy.control.close()
        if self.memory >= 0:
            os.close(self.memory)
            self.memory = -1

    def end(self) -> None:
        """End its processes."""
        for copy in self.copies.values():
            if copy.pid:
                with suppress(ProcessLookupError):
                    os.kill(copy.pid, signal.SIGKILL)
        self.close()


class SnapshotShelf:
    """The snapshots of the racks of one crate. Boards write to `boards_line` of their copies."""

    def __init__(self) -> None:
        self.line, self.boards_line = socketpair(AF_UNIX, SOCK_SEQPACKET)
        self._held: list[HeldSnapshot] = []
        self._taking: HeldSnapshot | None = None
        sizes = re.findall(r"MemTotal: +(\d+)", Path("/proc/meminfo").read_text())
        self._most_bytes = sum(int(kib) << 10 for kib in sizes) // MEMORY_PART

    def take_note(self, wirings: Mapping[str, Wiring]) -> None:
        """Take the next note of a board. `wirings`: those of all processes of a snapshot."""
        found = receive(self.line)
        if found is None:
            return
        note, files = CopyNote(**found[0]), found[1]
        if not files:
            for snapshot in self._held:
                if snapshot.tick == note.tick:
                    snapshot.copies[note.name].pid = note.pid
            return
        if self._taking is None or self._taking.tick != note.tick:
            self._drop_unfinished()
            self._taking = HeldSnapshot(note.tick)
        control, *memory = files
        self._taking.copies[note.name] = WaitingCopy(
            wirings[note.name], socket(fileno=control), note.pid
        )
        for fd in memory:
            self._taking.memory = fd
        if self._taking.memory >= 0 and self._taking.copies.keys() == wirings.keys():
            self._hold(self._taking)
            self._taking = None

    def _hold(self, snapshot: HeldSnapshot) -> None:
        for before in self._held:
            if before.tick == snapshot.tick:
                self.drop(before)
                break
        for before in self._held[-1:]:
            # It has got the memory that changes while a rack goes on.
            before.measure()
        self._held.append(snapshot)
        snapshot.private_bytes = os.fstat(snapshot.memory).st_size
        while len(self._held) > MOST_SNAPSHOTS or (
            len(self._held) > 2 and self.private_bytes > self._most_bytes
        ):
            self.drop(self._most_dispensable())

    def _most_dispensable(self) -> HeldSnapshot:
        """Return the snapshot of the older half, in the order in which they were taken, that leaves
        the smallest gap between its neighbours; never the newest, or the one of the first tick."""
        ticks = sorted(snapshot.tick for snapshot in self._held)
        older = self._held[: max(2, len(self._held) // 2)]
        candidates = [one for one in older if one.tick != ticks[0] and one is not self._held[-1]]

        def gap(snapshot: HeldSnapshot) -> int:
            at = ticks.index(snapshot.tick)
            return ticks[min(at + 1, len(ticks) - 1)] - ticks[at - 1]

        return min(candidates, key=gap, default=self._held[0])

    def __len__(self) -> int:
        return len(self._held)

    @property
    def private_bytes(self) -> int:
        """The memory that all of them have for themselves."""
        return sum(snapshot.private_bytes for snapshot in self._held)

    @property
    def pids(self) -> set[int]:
        """The processes of all copies that are known."""
        held = [*self._held, *([] if self._taking is None else [self._taking])]
        return {copy.pid for snapshot in held for copy in snapshot.copies.values()} - {0}

    def nearest(self, tick: int) -> HeldSnapshot | None:
        """Return the last whole snapshot at `tick` or before; None: there is none."""
        found = [one for one in self._held if one.tick <= tick]
        for snapshot in sorted(found, key=lambda one: one.tick, reverse=True):
            if all(copy.pid and _is_there(copy) for copy in snapshot.copies.values()):
                return snapshot
            self.drop(snapshot)
        return None

    def go_on(self, copy: WaitingCopy, wiring: Wiring, segment: int) -> int:
        """Let a copy go on in a segment, open as `segment`, as a child of this process, with the
        context in `wiring`; return its process. Its successor's note follows. Raises `OSError` if
        it is gone."""
        pid = copy.pid
        copy.pid = 0
        with ExitStack() as stack:
            contexts = []
            if copy.wiring != wiring and isinstance(wiring, TaskWiring):
                file = stack.enter_context(TemporaryFile(dir=SHM_FOLDER))
                file.write(pickle.dumps(wiring.context))
                file.seek(0)
                contexts.append(file.fileno())
            request = CopyRequest(os.getpid(), has_context=bool(contexts))
            send(copy.control, request, segment, *contexts)
        return pid

    def show(self, snapshot: HeldSnapshot, name: str) -> str:
        """Return the attributes of a level in a snapshot, as JSON; empty if its copy is gone."""
        control = snapshot.copies[name].control
        file = os.memfd_create("attributes", os.MFD_CLOEXEC)
        try:
            send(control, CopyRequest(), file)
            is_written = readable(control.fileno(), SHOW_S) and control.recv(1)
            return os.pread(file, os.fstat(file).st_size, 0).decode() if is_written else ""
        except OSError:
            return ""
        finally:
            os.close(file)

    def drop(self, snapshot: HeldSnapshot) -> None:
        """End a snapshot."""
        snapshot.end()
        self._held.remove(snapshot)

    def clear(self) -> None:
        """End all snapshots."""
        self._drop_unfinished()
        for snapshot in [*self._held]:
            self.drop(snapshot)

    def close_inherited(self) -> None:
        """Let go of all in a process forked from the crate."""
        self.line.close()
        unfinished: Iterable[HeldSnapshot] = [] if self._taking is None else [self._taking]
        for snapshot in (*self._held, *unfinished):
            snapshot.close()

    def _drop_unfinished(self) -> None:
        if self._taking is not None:
            self._taking.end()
            self._taking = None


def can_go_on(copy: WaitingCopy, wiring: Wiring) -> bool:
    """Say whether a copy can be the board of a wiring: it is that of its own, but for the settings
    of its level."""
    before = copy.wiring
    if isinstance(before, TaskWiring) and isinstance(wiring, TaskWiring):
        return replace(before, context=wiring.context) == wiring
    return before == wiring


def _is_there(copy: WaitingCopy) -> bool:
    """Say whether a copy waits: nothing else ends the other end of its socket."""
    return not readable(copy.control.fileno(), 0)
