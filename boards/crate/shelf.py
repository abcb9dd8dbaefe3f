"""Snapshots that a crate holds: a waiting copy of each process of a rack, and of the segment.

Their number and memory are limited. When a limit is exceeded, a snapshot of the older half is
dropped: the one whose removal leaves the smallest gap. A snapshot in which a copy has ended is
dropped as a whole. All copies end with the crate, because only the crate has the other ends of
their lines open.
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

from rack.boards.run.copying import ContinueRequest, receive_copy_message
from rack.boards.wiring import ClockWiring, TaskWiring

MOST_SNAPSHOTS = 32
MEMORY_PART = 4
"""Snapshots may use this part of the machine's memory: 1 / `MEMORY_PART`."""
SHOW_S = 10.0
"""Longest wait for a copy that reports the attributes of its level."""
Wiring = TaskWiring | ClockWiring


@dataclass
class WaitingCopy:
    """Forked copy of a process, which waits in a snapshot until a run continues from there.

    Attributes:
        wiring: Wiring of the process.
        line: Connection to the copy.
        pid: Process id of the copy. 0 after it has continued, until the copy that replaces it is
            known.
    """

    wiring: Wiring
    line: Connection
    pid: int

    def can_continue_as(self, wiring: Wiring) -> bool:
        """Return True if the copy can continue with a wiring.

        The wiring may differ from the copy's own only in the context of the level.
        """
        before = self.wiring
        if isinstance(before, TaskWiring) and isinstance(wiring, TaskWiring):
            return replace(before, context=wiring.context) == wiring
        return before == wiring

    def continue_as(self, wiring: Wiring, rack: str) -> int:
        """Let the copy continue as a board of a rack.

        Before it continues, it forks another copy that waits in its place. The process id of that
        copy arrives as a message.

        Args:
            wiring: Wiring that contains the new context of its level.
            rack: Name of the rack to whose segment it attaches.

        Returns:
            The process id of the copy, which becomes a child of this process.

        Raises:
            OSError: The copy has ended.
        """
        context = None
        if isinstance(wiring, TaskWiring) and wiring != self.wiring:
            context = wiring.context
        self.line.send(ContinueRequest(os.getpid(), rack, context))
        pid = self.pid
        self.pid = 0
        return pid

    def read_attributes(self) -> str:
        """Return the attributes of the copy's level as JSON. Empty if the copy does not answer."""
        with suppress(EOFError, OSError):
            self.line.send(None)
            if self.line.poll(SHOW_S):
                return self.line.recv_bytes().decode()
        return ""


@dataclass
class HeldSnapshot:
    """Snapshot of a rack, taken before a tick.

    Attributes:
        tick: The tick.
        copies: Copies of the rack's processes, keyed by name.
        memory: Descriptor of a file with a copy of the segment. -1 until it is received.
        private_bytes: Memory in bytes, as last measured, that it does not share with other
            processes.
        is_complete: Whether the copy of the segment and all copies of processes are present.
    """

    tick: int
    copies: dict[str, WaitingCopy] = field(default_factory=dict)
    memory: int = -1
    private_bytes: int = 0
    is_complete: bool = False

    def measure_memory(self) -> None:
        """Measure the memory that the snapshot does not share, and store it in `private_bytes`."""
        self.private_bytes = os.fstat(self.memory).st_size
        for copy in self.copies.values():
            with suppress(OSError):
                self.private_bytes += _read_size(f"{copy.pid}/smaps_rollup", "Private_Dirty")

    def close(self) -> None:
        """Close the descriptors of the snapshot in this process."""
        for copy in self.copies.values():
            copy.line.close()
        if self.memory >= 0:
            os.close(self.memory)


def _read_size(file: str, key: str) -> int:
    """Return the size in bytes that a file of /proc states, in kB, under a key."""
    sizes_kib = re.findall(rf"{key}: +(\d+)", Path("/proc", file).read_text())
    return sum(map(int, sizes_kib)) << 10


class SnapshotShelf:
    """Snapshots of a crate's racks, limited in number and memory.

    Attributes:
        line: Socket from which the crate receives messages about copies.
        boards_line: Socket to which boards send these messages.
    """

    def __init__(self) -> None:
        self.line, self.boards_line = socketpair(AF_UNIX, SOCK_SEQPACKET)
        # In the order in which they were taken. The last one may be incomplete.
        self._snapshots: list[HeldSnapshot] = []
        self._most_bytes = _read_size("meminfo", "MemTotal") // MEMORY_PART

    @property
    def _complete_snapshots(self) -> list[HeldSnapshot]:
        """Complete snapshots, in the order in which they were taken."""
        return [snapshot for snapshot in self._snapshots if snapshot.is_complete]

    def receive_copy_message(self, wirings: Mapping[str, Wiring]) -> None:
        """Receive a board's message about its copy, and add the copy to its snapshot.

        If the copy replaces one that has continued, the message only contains its process id.

        Args:
            wirings: Wirings of all processes that a complete snapshot contains, keyed by name.
        """
        note, files = receive_copy_message(self.line)
        if not files:
            for snapshot in self._complete_snapshots:
                if snapshot.tick == note.tick:
                    snapshot.copies[note.name].pid = note.pid
            return
        unfinished = next((held for held in self._snapshots if not held.is_complete), None)
        if unfinished is not None and unfinished.tick != note.tick:
            self.drop_snapshot(unfinished)
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
            self._add_complete_snapshot(unfinished)

    def _add_complete_snapshot(self, snapshot: HeldSnapshot) -> None:
        """Add a complete snapshot, which replaces one of the same tick.

        Drop other snapshots if there are more than the limits of number and memory permit.
        """
        for before in self._complete_snapshots:
            if before.tick == snapshot.tick:
                self.drop_snapshot(before)
        for before in self._complete_snapshots[-1:]:
            # The pages that the rack has changed since are now private to the previous snapshot.
            before.measure_memory()
        self._snapshots.append(snapshot)
        snapshot.is_complete = True
        snapshot.private_bytes = os.fstat(snapshot.memory).st_size
        while len(self) > MOST_SNAPSHOTS or (
            len(self) > 2 and self.private_bytes > self._most_bytes
        ):
            self.drop_snapshot(self._choose_snapshot_to_drop())

    def _choose_snapshot_to_drop(self) -> HeldSnapshot:
        """Return the snapshot in the older half whose removal leaves the smallest gap in ticks.

        Neither the newest snapshot nor the one with the first tick is chosen.
        """
        held = self._complete_snapshots
        ticks = sorted(snapshot.tick for snapshot in held)
        older = held[: max(2, len(held) // 2)]
        candidates = [old for old in older if old.tick != ticks[0] and old is not held[-1]]

        def compute_gap(snapshot: HeldSnapshot) -> int:
            """Return the gap, in ticks, that the removal of a snapshot would leave."""
            at = ticks.index(snapshot.tick)
            return ticks[min(at + 1, len(ticks) - 1)] - ticks[at - 1]

        return min(candidates, key=compute_gap, default=held[0])

    def __len__(self) -> int:
        return len(self._complete_snapshots)

    @property
    def private_bytes(self) -> int:
        """Total memory in bytes that the snapshots do not share with other processes."""
        return sum(snapshot.private_bytes for snapshot in self._complete_snapshots)

    @property
    def pids(self) -> set[int]:
        """Known process ids of all copies."""
        return {copy.pid for held in self._snapshots for copy in held.copies.values()} - {0}

    def find_nearest(self, tick: int) -> HeldSnapshot | None:
        """Return the last usable snapshot at or before `tick`. None if there is none.

        Snapshots in which a copy has ended are dropped.
        """
        earlier = [held for held in self._complete_snapshots if held.tick <= tick]
        for snapshot in sorted(earlier, key=lambda held: held.tick, reverse=True):
            # A readable line means that the copy at its other end has ended.
            if all(copy.pid and not copy.line.poll() for copy in snapshot.copies.values()):
                return snapshot
            self.drop_snapshot(snapshot)
        return None

    def drop_snapshot(self, snapshot: HeldSnapshot) -> None:
        """Remove a snapshot and kill its copies."""
        for copy in snapshot.copies.values():
            if copy.pid:
                with suppress(ProcessLookupError):
                    os.kill(copy.pid, signal.SIGKILL)
        snapshot.close()
        self._snapshots.remove(snapshot)

    def drop_all(self) -> None:
        """Remove all snapshots."""
        for snapshot in [*self._snapshots]:
            self.drop_snapshot(snapshot)

    def close_inherited(self) -> None:
        """Close the descriptors that a process forked from the crate does not need."""
        self.line.close()
        for snapshot in self._snapshots:
            snapshot.close()
