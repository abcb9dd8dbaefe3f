"""The crate: a process that imports the levels once and forks every board.

Importing numpy, MuJoCo and the planning libraries takes half a second, and loading compiled code
takes another half. Forked boards share the result, including one compiled cell. The crate stays
single-threaded, so that it can fork at any time. As the parent of the boards it reaps them, and the
kernel kills them if it ends.

It is started as `python -m rack.boards.crate LINE ATTENTION`. The arguments are the descriptors of
the line to the Rack and of the eventfd to which boards write.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Collection
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection, wait
from socket import socket
from time import monotonic, monotonic_ns

from rack.backplane.address_map import CLOCK_STANDBY
from rack.backplane.copies import restore_memory
from rack.backplane.lines import UtilityLines
from rack.backplane.memory import record_used_files
from rack.backplane.process import (
    adopt_orphans,
    describe_refusal,
    list_children,
    set_priority,
    wait_readable,
)
from rack.backplane.segment import Segment
from rack.backplane.semaphores import get_done_semaphore
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards.crate.line import receive_or_none
from rack.boards.crate.output import HostOutput
from rack.boards.crate.requests import (
    Compiling,
    Ended,
    Forked,
    ForkFailed,
    Leave,
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
from rack.boards.crate.shelf import SnapshotShelf, WaitingCopy, Wiring
from rack.boards.errors import MAX_REASON_LENGTH, to_one_line
from rack.boards.faults.tasks import run_core_fault
from rack.boards.run.board import run_board, run_clock_board, run_task_board
from rack.boards.run.compiled_mailbox import load_machine_code
from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring
from rack.levels import compiled
from rack.levels.errors import RobotError
from rack.levels.level import Executor, Planner
from rack.levels.references import find_class

Source = Connection | socket | int
"""Object whose readiness the crate can wait for."""
HOST_PROCESSES = 4
"""Number of processes that are not in the layout: Rack, crate, clock and recorder."""
OUTPUT_PAUSE_S = 0.01
"""Time between two reads of a host board's output, so that endless output delays nothing else."""
ORPHANS_S = 1.0
"""Longest wait for the end of processes that a host board has started."""
LEAVE_S = 0.5
"""Time that boards have to end by themselves when the crate leaves a rack."""


class Crate:
    """Parent process of all boards. It ends when the Rack closes the line or the launcher ends.

    Args:
        line: Connection to the Rack.
        attention: Descriptor of the eventfd to which boards write.
    """

    def __init__(self, line: Connection, attention: int) -> None:
        self._line = line
        self._attention = attention
        # Segment of the present rack, from its `Open` request on.
        self._opened: Segment | None = None
        # Name and process id of each board, by pidfd.
        self._boards: dict[int, tuple[str, int]] = {}
        self._shelf = SnapshotShelf()
        self._wirings: dict[str, Wiring] = {}
        self._copies_to_continue: dict[str, WaitingCopy] = {}
        self._preloaded: set[str] = set()
        self._outputs: dict[str, HostOutput] = {}
        self._paused_outputs: list[HostOutput] = []
        # A closed line is not enough to detect the end of the launcher: a process that it forked
        # may keep the other end open.
        self._launcher = os.pidfd_open(os.getppid())

    @property
    def _segment(self) -> Segment:
        """Segment of the present rack. Use it only while a rack is open."""
        assert self._opened is not None, "a rack is open"
        return self._opened

    def run(self) -> None:
        """Serve requests until the Rack closes the line or the launcher ends.

        Then end all boards and all copies in snapshots.
        """
        while True:
            printing = [
                output for output in self._outputs.values() if output not in self._paused_outputs
            ]
            ready = self._reap_ended(
                OUTPUT_PAUSE_S if self._paused_outputs else None,
                self._line,
                self._launcher,
                *(output.reader for output in printing),
            )
            if not ready:
                self._paused_outputs.clear()
            for output in printing:
                if output.reader in ready:
                    output.copy_output()
                    self._paused_outputs.append(output)
            is_gone = self._launcher in ready
            if is_gone or self._line in ready:
                request = None if is_gone else receive_or_none(self._line)
                if request is None:
                    self._leave_rack()
                    had_any = len(self._shelf) > 0
                    self._shelf.drop_all()
                    self._reap_copies(are_all=had_any)
                    return
                self._serve_request(request)

    def _serve_request(self, request: object) -> None:
        """Carry out one request of the Rack."""
        match request:
            case Preload() as preload:
                self._preload_levels(preload)
            case Open() as opening:
                self._open_rack(opening)
            case PowerOn(name, TaskWiring() | ClockWiring() as wiring):
                self._power_on(name, wiring)
            case PowerOn(name, HostWiring() as host):
                # A restarted host board prints into the same pipe.
                if name not in self._outputs:
                    self._outputs[name] = HostOutput(name)
                lines = self._attention, self._outputs[name].writer
                # Import the module in the forked process, so that the crate stays small.
                self._fork_board(
                    name,
                    lambda segment: import_module("rack.boards.host.board").run_host_board(
                        segment, host, *lines
                    ),
                )
            case PowerOn(name, int() as entry):
                self._fork_board(name, lambda segment: run_core_fault(segment, entry))
            case PowerOff(name):
                self._kill_boards(name)
            case Leave():
                self._leave_rack()
                # If the Rack is gone, `run` detects that on its next pass.
                with suppress(OSError):
                    self._line.send(request)
            case Show(tick, name):
                snapshot = self._shelf.find_nearest(tick)
                text = (
                    "" if snapshot is None or not name else snapshot.copies[name].read_attributes()
                )
                self._line.send(Shown(-1 if snapshot is None else snapshot.tick, text))

    def _open_rack(self, opening: Open) -> None:
        """Attach to the segment of a rack, and report this to the Rack.

        If the rack continues a run, the memory of the segment is restored from a snapshot.
        """
        self._opened = segment = Segment.attach(opening.rack)
        if not segment.words[System.LOCKSTEP]:
            record_used_files()
        set_priority(opening.priority)
        snapshot = None if opening.before is None else self._shelf.find_nearest(opening.before)
        if snapshot is not None:
            restore_memory(segment, snapshot.memory, snapshot.tick)
            self._copies_to_continue = {**snapshot.copies}
            self._publish_snapshots()
        self._line.send(Opened(-1 if snapshot is None else snapshot.tick))

    def _power_on(self, name: str, wiring: Wiring) -> None:
        """Start a task or the clock.

        If the snapshot contains a copy that can continue with this wiring, it continues. Otherwise
        a new process is forked.
        """
        if name != CLOCK_STANDBY:
            # A standby of the clock has no state, so snapshots do not contain it.
            self._wirings[name] = wiring
        copy = self._copies_to_continue.pop(name, None)
        if copy is not None and copy.can_continue_as(wiring):
            try:
                self._watch_process(name, copy.continue_as(wiring, self._segment.rack))
            except OSError:
                self._report_fork_failure(name, "its copy in the snapshot is gone")
            return
        lines = self._attention, self._shelf.boards_line
        if isinstance(wiring, TaskWiring):
            self._fork_board(name, lambda segment: run_task_board(segment, wiring, *lines))
            return
        if copy is not None:
            # The new clock continues the run, as after the loss of a clock.
            self._segment.words[System.STATE] = Run.RUNNING
        self._fork_board(name, lambda segment: run_clock_board(segment, wiring, *lines))

    def _receive_copy_message(self) -> None:
        """Receive a board's message about its copy, and publish the number of snapshots."""
        self._shelf.receive_copy_message(self._wirings)
        self._publish_snapshots()

    def _publish_snapshots(self) -> None:
        """Write the number of snapshots and their size in bytes to the backplane."""
        words = self._segment.words
        words[System.SNAPSHOTS] = len(self._shelf)
        words[System.SNAPSHOT_BYTES] = self._shelf.private_bytes

    def _preload_levels(self, request: Preload) -> None:
        """Import and preload levels and compile the cell, so that all boards share the results.

        Mistakes in the config are ignored here, because the Rack reports them.
        """
        sys.path[:] = request.path
        compiled.on_compile = lambda function: self._line.send(Compiling(function))
        load_machine_code()
        for reference in request.classes:
            if reference in self._preloaded:
                continue
            self._line.send(Preloading(reference))
            with suppress(LookupError):
                # The launcher first tries the import in a child process, to detect a module that
                # ends the process that imports it.
                kind = find_class(reference, object, in_child_first=False)
                try:
                    if issubclass(kind, Executor | Planner):
                        kind.preload()
                except Exception as error:
                    text = f"{type(error).__name__}: {error}"
                    self._line.send(PreloadFailed(reference, to_one_line(text, MAX_REASON_LENGTH)))
                    return
                self._preloaded.add(reference)
        if request.cell is not None:
            # Compile the cell once for all boards. The Rack reports mistakes in it.
            from rack.levels.robot.cell import build_cell

            with suppress(RobotError):
                build_cell(request.cell.robot, request.cell.scene, request.cell.clock_ns)
        compiled.on_compile = None
        gc.freeze()
        gc.enable()

    def _fork_board(self, name: str, board: Callable[[Segment], int]) -> None:
        """Fork a process that runs `board` and exits with the status that it returns."""
        crate = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            needed = f"the rack needs {len(self._segment.layout.processes) + HOST_PROCESSES}"
            self._report_fork_failure(name, f"{describe_refusal(error)}; {needed}")
            return
        if pid == 0:
            self._line.close()
            self._shelf.close_inherited()
            # The child must exit here, so that the code of the crate does not run twice.
            status = os.EX_SOFTWARE
            try:
                status = run_board(crate, name, self._segment, board)
            finally:
                os._exit(status)
        self._watch_process(name, pid)

    def _report_fork_failure(self, name: str, why: str) -> None:
        """Mark a board that could not be forked as lost, and report it to the Rack."""
        end = Ended(name, os.EX_OSERR, monotonic_ns(), self._mark_lost(name))
        with suppress(OSError):
            self._line.send(ForkFailed(end, f"board '{name}' cannot be forked: {why}"))

    def _watch_process(self, name: str, pid: int) -> None:
        """Report a new process of a board to the Rack, and watch for its end."""
        pidfd = os.pidfd_open(pid)
        self._boards[pidfd] = name, pid
        # If the Rack has closed the line, the crate must continue, in order to end its boards.
        with suppress(OSError):
            self._line.send(Forked(name, pid))

    def _kill_orphans(self) -> None:
        """Kill the remaining descendants of a host board that has ended, in whatever session.

        They have become children of the crate.
        """
        deadline = monotonic() + ORPHANS_S
        while monotonic() < deadline:
            boards = {pid for _, pid in self._boards.values()}
            orphans = list_children(os.getpid()) - boards - self._shelf.pids
            if not orphans:
                return
            for pid in orphans:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, os.WNOHANG)

    def _mark_lost(self, name: str) -> int:
        """Mark a board as lost on the backplane, where the clock and the other boards see it.

        A host board whose program is finished is not lost.

        Returns:
            The tick at which the board ended.
        """
        words = self._segment.words
        tick = words[System.TICK]
        if name in self._segment.map.blocks and words[System.STATE] != Run.STOPPED:
            block = self._segment.get_block(name)
            # In lockstep the board may have finished part of a batch of cycles.
            tick = max(tick, min(block[Block.DONE] + 1, block[Block.RELEASED]))
            if self._is_host(name) and block[Block.STATE] == TaskState.ENDED:
                # Its program is finished. Only host boards can end before the run does.
                block[Block.PID] = 0
                return tick
            # An odd number tells the clock that a loss is being recorded.
            words[System.LOSSES] += 1
            if block[Block.STATE] != TaskState.FAILED:
                block[Block.STATE] = TaskState.ABSENT
            block[Block.LOST] = block[Block.LOST] or tick + 1
            if not self._is_host(name):
                UtilityLines(self._segment).assert_sysfail(
                    self._segment.layout.find_task(name).slot
                )
            words[System.LOSSES] += 1
            # In lockstep the clock may be waiting for this semaphore.
            get_done_semaphore(self._segment, name).release()
        return tick

    def _is_host(self, name: str) -> bool:
        """Return True if this is the name of a host board."""
        return any(host.name == name for host in self._segment.layout.hosts)

    def _kill_boards(self, board: str | None = None) -> None:
        """Kill the board of this name, or all boards if it is None."""
        for pidfd, (name, _) in self._boards.items():
            if board in (None, name):
                signal.pidfd_send_signal(pidfd, signal.SIGKILL)

    def _leave_rack(self) -> None:
        """Wait for the boards of the present rack to end, kill those that do not, and detach."""
        deadline = monotonic() + LEAVE_S
        for pidfd, (name, _) in self._boards.items():
            if self._is_host(name):
                # A host program may block without a time limit, and only a signal can interrupt it.
                signal.pidfd_send_signal(pidfd, signal.SIGTERM)
        while self._boards and (left := deadline - monotonic()) > 0:
            self._reap_ended(left)
        self._kill_boards()
        while self._boards:
            self._reap_ended(None)
        # Receive the messages about copies that boards sent before they ended.
        while wait_readable(self._shelf.line.fileno(), 0):
            self._receive_copy_message()
        self._reap_copies()
        for output in self._outputs.values():
            output.close()
        self._outputs.clear()
        self._paused_outputs.clear()
        self._copies_to_continue.clear()
        self._wirings.clear()
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def _reap_copies(self, are_all: bool = False) -> None:
        """Reap copies that have ended. If `are_all` is true, first wait until all have ended."""
        with suppress(ChildProcessError):
            while os.waitpid(-1, 0 if are_all else os.WNOHANG)[0]:
                continue

    def _reap_ended(self, timeout_s: float | None, *others: Source) -> Collection[object]:
        """Wait for an event, reap boards that have ended, and receive messages about copies.

        Args:
            timeout_s: Longest time to wait in s. None to wait without a limit.
            others: Objects to wait for in addition to boards and messages about copies.

        Returns:
            All objects that are ready. Empty after the time-out.
        """
        ready = wait([self._shelf.line, *self._boards, *others], timeout_s)
        for pidfd in [pidfd for pidfd in self._boards if pidfd in ready]:
            seen_ns = monotonic_ns()
            name, pid = self._boards.pop(pidfd)
            tick = self._mark_lost(name)
            os.close(pidfd)
            _, status = os.waitpid(pid, 0)
            if self._is_host(name):
                self._kill_orphans()
                self._outputs[name].copy_output(is_over=True)
            with suppress(OSError):
                self._line.send(Ended(name, os.waitstatus_to_exitcode(status), seen_ns, tick))
        if self._shelf.line in ready:
            self._receive_copy_message()
        return ready


def main() -> None:
    """Run a crate that serves the Rack at the other end of the inherited socket."""
    # Ctrl-C reaches every process of the group, but only the Rack decides how the run ends.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    adopt_orphans()
    line, attention = (int(fd) for fd in sys.argv[1:])
    Crate(Connection(line), attention).run()
