"""The crate: a small process that imports and preloads the boards' levels, then forks every board
from itself.

Importing numpy, MuJoCo and the planning libraries takes half a second, and loading compiled code as
long again; forked boards share the result, and with it one compiled cell. The crate stays
single-threaded, so that forking is safe at any time. As the boards' parent it reaps them, and the
kernel kills them if it ends. It is started as `python -m rack.boards.crate LINE ATTENTION`: the
descriptors of the line and of the eventfd to which boards write.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection, wait
from socket import socket

from rack.backplane.copies import fill_memory
from rack.backplane.lines import UtilityLines
from rack.backplane.memory import note_used_files
from rack.backplane.process import adopt_orphans, children_of, readable, refusal, set_priority
from rack.backplane.segment import Segment
from rack.backplane.semaphores import done_semaphore
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards.classes import find_class
from rack.boards.crate.line import received
from rack.boards.crate.output import HostOutput
from rack.boards.crate.requests import (
    Compiling,
    Ended,
    Forked,
    ForkFailed,
    HogWiring,
    Leave,
    Left,
    Open,
    Opened,
    PowerOff,
    PowerOn,
    Preload,
    PreloadFailed,
    Preloading,
    Show,
    Shown,
)
from rack.boards.crate.shelf import SnapshotShelf, WaitingCopy
from rack.boards.errors import LONGEST_REASON, one_line
from rack.boards.faults.tasks import act_on_core
from rack.boards.run.board import enter, run_clock_board, run_task_board
from rack.boards.run.compiled_mailbox import load_machine_code
from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring
from rack.levels import compiled
from rack.levels.errors import RobotError
from rack.levels.level import Executor, Planner

Source = Connection | socket | int
"""What the crate waits for."""
HOST_BOARD = "rack.boards.host.board"
"""What runs a host board's program, by name: a rack without host boards does not load it."""
HOST_PROCESSES = 4
"""Processes beside those of the layout: Rack, crate, clock, recorder."""
REST_S = 0.01
"""Time between two reads of what host boards print: one that prints without end waits, and delays
no other."""
ORPHANS_S = 1.0
"""Longest wait for the end of what a host board has started."""
LEAVE_S = 0.5
"""Time for boards to end by themselves after the launcher has gone."""


class Crate:
    """The parent of all boards. Lives until the Rack closes the line."""

    def __init__(self, line: Connection, attention: int) -> None:
        self._line = line
        self._attention = attention
        self._opened: Segment | None = None  # that of the Rack, from its request on
        self._boards: dict[int, tuple[str, int]] = {}  # pidfd -> name, pid
        self._shelf = SnapshotShelf()
        self._wirings: dict[str, TaskWiring | ClockWiring] = {}
        self._to_go_on: dict[str, WaitingCopy] = {}
        self._preloaded: set[str] = set()
        self._outputs: dict[str, HostOutput] = {}
        self._resting: list[HostOutput] = []
        # The line alone does not show that the launcher is gone: a process that it forked may hold
        # its end open.
        self._launcher = os.pidfd_open(os.getppid())

    @property
    def _segment(self) -> Segment:
        assert self._opened is not None, "a rack is open"
        return self._opened

    def run(self) -> None:
        """Serve the Rack until it is gone, then make sure that no board is left."""
        while True:
            printing = [output for output in self._outputs.values() if output not in self._resting]
            readers = [output.reader for output in printing]
            ready = self._reap_ended(
                REST_S if self._resting else None, self._line, self._launcher, *readers
            )
            if not ready:
                self._resting.clear()
            for output in printing:
                if output.reader in ready:
                    output.pass_on()
                    self._resting.append(output)
            is_gone = self._launcher in ready
            if is_gone or self._line in ready:
                request = None if is_gone else received(self._line)
                if request is None:
                    self._leave()
                    had_any = len(self._shelf) > 0
                    self._shelf.clear()
                    self._reap_copies(are_all=had_any)
                    return
                self._serve(request)

    def _serve(self, request: object) -> None:
        match request:
            case Preload() as wanted:
                self._preload(wanted)
            case Open() as wanted_rack:
                self._open(wanted_rack)
            case PowerOn(name, TaskWiring() | ClockWiring() as wiring):
                self._power_on(name, wiring)
            case PowerOn(name, HostWiring() as host):
                # All processes of a host board print into one pipe.
                if name not in self._outputs:
                    self._outputs[name] = HostOutput(name)
                lines = self._attention, self._outputs[name].writer
                # Its process alone imports what that takes.
                self._fork(
                    name,
                    lambda segment: import_module(HOST_BOARD).run_host_board(segment, host, *lines),
                )
            case PowerOn(name, HogWiring(entry)):
                self._fork(name, lambda segment: act_on_core(segment, entry))
            case PowerOff(name):
                self._kill(name)
            case Leave():
                self._leave()
                # A Rack that is gone is noticed next.
                with suppress(OSError):
                    self._line.send(Left())
            case Show(tick, name):
                snapshot = self._shelf.nearest(tick)
                text = "" if snapshot is None or not name else snapshot.copies[name].show()
                self._line.send(Shown(-1 if snapshot is None else snapshot.tick, text))

    def _open(self, wanted: Open) -> None:
        """Attach to a segment; fill it if its rack goes on from a snapshot."""
        self._opened = segment = Segment.attach(wanted.rack)
        note_used_files()
        set_priority(wanted.priority)
        snapshot = None if wanted.before is None else self._shelf.nearest(wanted.before)
        if snapshot is not None:
            fill_memory(segment, snapshot.memory, snapshot.tick)
            self._to_go_on = {**snapshot.copies}
            self._state_snapshots()
        self._line.send(Opened(-1 if snapshot is None else snapshot.tick))

    def _power_on(self, name: str, wiring: TaskWiring | ClockWiring) -> None:
        """Fork a task or the clock, or let its copy go on."""
        self._wirings[name] = wiring
        copy = self._to_go_on.pop(name, None)
        if copy is not None and copy.can_be(wiring):
            try:
                self._watch(name, copy.go_on(wiring, self._segment.rack))
            except OSError:
                self._fail_to_fork(name, "its copy in the snapshot is gone")
            return
        lines = self._attention, self._shelf.boards_line
        if isinstance(wiring, TaskWiring):
            self._fork(name, lambda segment: run_task_board(segment, wiring, *lines))
            return
        if copy is not None:
            # As after the loss of a clock: it continues the run.
            self._segment.words[System.STATE] = Run.RUNNING
        self._fork(name, lambda segment: run_clock_board(segment, wiring, *lines))

    def _take_note(self) -> None:
        """Take the note of a board about its copy."""
        self._shelf.take_note(self._wirings)
        self._state_snapshots()

    def _state_snapshots(self) -> None:
        """State on the backplane how many snapshots there are, and how large."""
        words = self._segment.words
        words[System.SNAPSHOTS] = len(self._shelf)
        words[System.SNAPSHOT_BYTES] = self._shelf.private_bytes

    def _preload(self, wanted: Preload) -> None:
        """Load what boards share with the crate. Mistakes in the config are left for the Rack to
        report.
        """
        sys.path[:] = wanted.path
        compiled.on_compile = lambda function: self._line.send(Compiling(function))
        load_machine_code()
        for reference in wanted.classes:
            if reference in self._preloaded:
                continue
            self._line.send(Preloading(reference))
            with suppress(LookupError):
                # The launcher tries it, and outlives the crate.
                kind = find_class(reference, object, is_tried=False)
                try:
                    if issubclass(kind, Executor | Planner):
                        kind.preload()
                except Exception as error:
                    reason = one_line(f"{type(error).__name__}: {error}", LONGEST_REASON)
                    self._line.send(PreloadFailed(reference, reason))
                    return
                self._preloaded.add(reference)
        if wanted.cell is not None:
            # Compile the cell, once for all boards. A cell with mistakes is the Rack's to
            # report.
            from rack.levels.robot.cell import build_cell

            with suppress(RobotError):
                build_cell(wanted.cell.robot, wanted.cell.scene, wanted.cell.clock_ns)
        compiled.on_compile = None
        gc.freeze()
        gc.enable()

    def _fork(self, name: str, board: Callable[[Segment], int]) -> None:
        crate = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            needed = f"the rack needs {len(self._segment.layout.processes) + HOST_PROCESSES}"
            self._fail_to_fork(name, f"{refusal(error)}; {needed}")
            return
        if pid == 0:
            self._line.close()
            self._shelf.close_inherited()
            # The only exit of the child: the crate's own code must not run twice.
            status = os.EX_SOFTWARE
            try:
                status = enter(crate, name, self._segment, board)
            finally:
                os._exit(status)
        self._watch(name, pid)

    def _fail_to_fork(self, name: str, why: str) -> None:
        end = Ended(name, 0, os.EX_OSERR, time.monotonic_ns(), self._mark_lost(name))
        with suppress(OSError):
            self._line.send(ForkFailed(end, f"board '{name}' cannot be forked: {why}"))

    def _watch(self, name: str, pid: int) -> None:
        """Watch a process that has become a board."""
        pidfd = os.pidfd_open(pid)
        self._boards[pidfd] = name, pid
        # The Rack may have closed the line meanwhile: the crate must live to end its boards.
        with suppress(OSError):
            self._line.send(Forked(name, pid))

    def _end_orphans(self) -> None:
        """End whatever a host board has started, in any session: with its end it has become a child
        of the crate.
        """
        deadline = time.monotonic() + ORPHANS_S
        while time.monotonic() < deadline:
            boards = {pid for _, pid in self._boards.values()}
            orphans = children_of(os.getpid()) - boards - self._shelf.pids
            if not orphans:
                return
            for pid in orphans:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, os.WNOHANG)

    def _mark_lost(self, name: str) -> int:
        """Mark a board as lost on the backplane, for the clock and the other boards; return the
        tick.
        """
        words = self._segment.words
        tick = words[System.TICK]
        if name in self._segment.map.blocks and words[System.STATE] != Run.STOPPED:
            block = self._segment.block(name)
            # In lockstep it may have done part of a batch.
            tick = max(tick, min(block[Block.DONE] + 1, block[Block.RELEASED]))
            if self._is_host(name) and block[Block.STATE] == TaskState.ENDED:
                # Its program is done; a task ends with the run alone.
                block[Block.PID] = 0
                return tick
            # Odd while the loss is recorded: what the clock sees in between is not final.
            words[System.LOSSES] += 1
            if block[Block.STATE] != TaskState.FAILED:
                block[Block.STATE] = TaskState.ABSENT
            block[Block.LOST] = block[Block.LOST] or tick + 1
            if not self._is_host(name):
                UtilityLines(self._segment).assert_sysfail(self._segment.layout.task(name).slot)
            words[System.LOSSES] += 1
            # In lockstep the clock waits for this.
            done_semaphore(self._segment, name).release()
        return tick

    def _is_host(self, name: str) -> bool:
        return any(host.name == name for host in self._segment.layout.hosts)

    def _kill(self, board: str | None = None) -> None:
        for pidfd, (name, _) in self._boards.items():
            if board in (None, name):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)

    def _leave(self) -> None:
        """Leave a rack whose Rack is gone, or wants that: boards notice it and end; those that take
        too long are killed.
        """
        deadline = time.monotonic() + LEAVE_S
        for pidfd, (name, _) in self._boards.items():
            if self._is_host(name):
                # It may block for ever: only a signal gets it out of that.
                signal.pidfd_send_signal(pidfd, signal.SIGTERM)
        while self._boards and (left := deadline - time.monotonic()) > 0:
            self._reap_ended(left)
        self._kill()
        while self._boards:
            self._reap_ended(None)
        # What boards wrote of their copies before they ended.
        while readable(self._shelf.line.fileno(), 0):
            self._take_note()
        self._reap_copies()
        for output in self._outputs.values():
            output.close()
        self._outputs.clear()
        self._resting.clear()
        self._to_go_on.clear()
        self._wirings.clear()
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _reap_copies(self, are_all: bool = False) -> None:
        """Reap the copies that have ended since; wait for their end if `are_all` to end."""
        with suppress(ChildProcessError):
            while os.waitpid(-1, 0 if are_all else os.WNOHANG)[0]:
                continue

    def _reap_ended(self, timeout_s: float | None, *others: Source) -> Collection[object]:
        """Reap boards that end, and take notes of others, until something happens; return what was
        ready of these and of `others`.
        """
        ready = wait([self._shelf.line, *self._boards, *others], timeout_s)
        for pidfd in [pidfd for pidfd in self._boards if pidfd in ready]:
            seen_ns = time.monotonic_ns()
            name, pid = self._boards.pop(pidfd)
            tick = self._mark_lost(name)
            os.close(pidfd)
            _, status = os.waitpid(pid, 0)
            if self._is_host(name):
                self._end_orphans()
                self._outputs[name].pass_on(is_over=True)
            with suppress(OSError):
                self._line.send(Ended(name, pid, os.waitstatus_to_exitcode(status), seen_ns, tick))
        if self._shelf.line in ready:
            self._take_note()
        return ready


def main() -> None:
    """Serve as the crate of the Rack at the other end of the inherited socket."""
    # Ctrl-C reaches every process of the group, but the Rack decides how the run ends.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    adopt_orphans()
    line, attention = (int(fd) for fd in sys.argv[1:])
    Crate(Connection(line), attention).run()
