"""The snapshots that a crate holds: of each process of a rack a copy that waits, and the memory of
the segment.

They are bounded in number and in memory, and thinned out with age: of the older half, the one goes
that leaves the smallest gap. A snapshot of which a copy is lost goes whole. All end with the crate:
it holds the only other end of each copy's line.
"""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from socket import AF_UNIX, SOCK_SEQPACKET, socketpair

from rack.boards.run.copying import GoOn, receive_note
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
    line: Connection
    pid: int

    def can_be(self, wiring: Wiring) -> bool:
        """Say whether it can be the board of a wiring: it is that of its own, but for the settings
        of its level.
        """
        before = self.wiring
        if isinstance(before, TaskWiring) and isinstance(wiring, TaskWiring):
            return replace(before, context=wiring.context) == wiring
        return before == wiring

    def go_on(self, wiring: Wiring, rack: str) -> int:
        """Let it go on in the segment of a rack, as a child of this process, with the context in
        `wiring`; return its process. Its successor's note follows. Raises `OSError` if it is
        gone.
        """
        context = None
        if isinstance(wiring, TaskWiring) and wiring != self.wiring:
            context = wiring.context
        self.line.send(GoOn(os.getpid(), rack, context))
        pid = self.pid
        self.pid = 0
        return pid

    def show(self) -> str:
        """Return the attributes of its level, as JSON; empty if it is gone."""
        with suppress(EOFError, OSError):
            self.line.send(None)
            if self.line.poll(SHOW_S):
                return self.line.recv_bytes().decode()
        return ""


@dataclass
class HeldSnapshot:
    """The copies of all processes of a rack before `tick`, by name, and its memory, a file.

    `private_bytes`: the memory that it has for itself, when it was last measured. `is_whole`: it
    has all of them.
    """

    tick: int
    copies: dict[str, WaitingCopy] = field(default_factory=dict)
    memory: int = -1
    private_bytes: int = 0
    is_whole: bool = False

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
            copy.line.close()
        if self.memory >= 0:
            os.close(self.memory)


class SnapshotShelf:
    """The snapshots of the racks of one crate. Boards write to `boards_line` of their copies."""

    def __init__(self) -> None:
        self.line, self.boards_line = socketpair(AF_UNIX, SOCK_SEQPACKET)
        # In the order in which they were taken: the last one may not be whole yet.
        self._snapshots: list[HeldSnapshot] = []
        sizes = re.findall(r"MemTotal: +(\d+)", Path("/proc/meminfo").read_text())
        self._most_bytes = sum(int(kib) << 10 for kib in sizes) // MEMORY_PART

    @property
    def _held(self) -> list[HeldSnapshot]:
        return [snapshot for snapshot in self._snapshots if snapshot.is_whole]

    def take_note(self, wirings: Mapping[str, Wiring]) -> None:
        """Take the next note of a board. `wirings`: those of all processes of a snapshot."""
        note, files = receive_note(self.line)
        if not files:
            for snapshot in self._held:
                if snapshot.tick == note.tick:
                    snapshot.copies[note.name].pid = note.pid
            return
        unfinished = next((one for one in self._snapshots if not one.is_whole), None)
        if unfinished is not None and unfinished.tick != note.tick:
            self.drop(unfinished)
            unfinished = None
        if unfinished is None:
            unfinished = HeldSnapshot(note.tick)
            self._snapshots.append(unfinished)
        line, *memory = files
        unfinished.copies[note.name] = WaitingCopy(wirings[note.name], Connection(line), note.pid)
        for fd in memory:
            unfinished.memory = fd
        if unfinished.memory >= 0 and unfinished.copies.keys() == wirings.keys():
            self._snapshots.remove(unfinished)
            self._hold(unfinished)

    def _hold(self, snapshot: HeldSnapshot) -> None:
        for before in self._held:
            if before.tick == snapshot.tick:
                self.drop(before)
        for before in self._held[-1:]:
            # It has got the memory that changes while a rack goes on.
            before.measure()
        self._snapshots.append(snapshot)
        snapshot.is_whole = True
        snapshot.private_bytes = os.fstat(snapshot.memory).st_size
        while len(self) > MOST_SNAPSHOTS or (
            len(self) > 2 and self.private_bytes > self._most_bytes
        ):
            self.drop(self._most_dispensable())

    def _most_dispensable(self) -> HeldSnapshot:
        """Return the snapshot of the older half, in the order in which they were taken, that leaves
        the smallest gap between its neighbours; never the newest, or the one of the first tick.
        """
        held = self._held
        ticks = sorted(snapshot.tick for snapshot in held)
        older = held[: max(2, len(held) // 2)]
        candidates = [one for one in older if one.tick != ticks[0] and one is not held[-1]]

        def gap(snapshot: HeldSnapshot) -> int:
            at = ticks.index(snapshot.tick)
            return ticks[min(at + 1, len(ticks) - 1)] - ticks[at - 1]

        return min(candidates, key=gap, default=held[0])

    def __len__(self) -> int:
        return len(self._held)

    @property
    def private_bytes(self) -> int:
        """The memory that all of them have for themselves."""
        return sum(snapshot.private_bytes for snapshot in self._held)

    @property
    def pids(self) -> set[int]:
        """The processes of all copies that are known."""
        return {copy.pid for one in self._snapshots for copy in one.copies.values()} - {0}

    def nearest(self, tick: int) -> HeldSnapshot | None:
        """Return the last whole snapshot at `tick` or before; None: there is none."""
        found = [one for one in self._held if one.tick <= tick]
        for snapshot in sorted(found, key=lambda one: one.tick, reverse=True):
            # Every copy waits: nothing else ends the other end of its line.
            if all(copy.pid and not copy.line.poll() for copy in snapshot.copies.values()):
                return snapshot
            self.drop(snapshot)
        return None

    def drop(self, snapshot: HeldSnapshot) -> None:
        """End a snapshot and its processes."""
        for copy in snapshot.copies.values():
            if copy.pid:
                with suppress(ProcessLookupError):
                    os.kill(copy.pid, signal.SIGKILL)
        snapshot.close()
        self._snapshots.remove(snapshot)

    def clear(self) -> None:
        """End all snapshots."""
        for snapshot in [*self._snapshots]:
            self.drop(snapshot)

    def close_inherited(self) -> None:
        """Let go of all in a process forked from the crate."""
        self.line.close()
        for snapshot in self._snapshots:
            snapshot.close()
