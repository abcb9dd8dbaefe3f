"""SIGINT, SIGTERM and SIGHUP end a command within 2 s, with exit status 128 + signal.

They leave no process and no segment behind. A command with nothing to finish ends inside the signal
handler. Raising an exception there, as Python does, was rejected: it may occur after a segment has
been created and before its owner has been recorded, and libraries that are being imported turn it
into other errors. A command with something to finish uses `stop_orderly`, and has `BOUND_S` for it.
"""

from __future__ import annotations

import os
import select
import signal
import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import NamedTuple, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
BOUND_S = 1.7
"""Longest time from the first signal to the end of the process."""
CHILDREN_END_S = 0.25
"""Longest wait for killed children to end."""
SHOW_CURSOR = b"\x1b[?25h\n"
"""Control sequence that shows the cursor of a terminal."""


class Interrupted(BaseException):
    """Raised in a waiting command so that it withdraws its request."""


class _SignalReaction(NamedTuple):
    """Reaction to the first signal, with a message for a command that does not end in time."""

    stop: Callable[[], object]
    unfinished: str = ""


class Interrupt:
    """Handles the signals of this process.

    Attributes:
        number: Number of the first signal received. 0 before that.
    """

    def __init__(self) -> None:
        self.number = 0
        self._reactions: list[_SignalReaction] = [_SignalReaction(self.end_process)]

    @property
    def name(self) -> str:
        """Name of the signal received, such as SIGINT. Empty before that."""
        return signal.Signals(self.number).name if self.number else ""

    def install_handlers(self) -> None:
        """Install the signal handlers.

        Without them a signal kills the process, with the same exit status.
        """
        for number in SIGNALS:
            # Leave SIGHUP ignored under nohup, so that the command outlives its terminal.
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._handle_signal)
        signal.signal(signal.SIGALRM, lambda number, frame: self.end_process())

    @contextmanager
    def stop_orderly(
        self, stop: Callable[[], object] = lambda: None, unfinished: str = ""
    ) -> Iterator[None]:
        """Call `stop` at the first signal, after which the command is expected to end by itself.

        Args:
            stop: Called in the signal handler, or at once if a signal has been received already.
            unfinished: Printed if the command has not ended within `BOUND_S`. Tells the user what
                to do.
        """
        self._reactions.append(_SignalReaction(stop, unfinished))
        try:
            if self.number:
                stop()
            yield
        finally:
            self._reactions.pop()

    def raise_interrupted(self) -> AbstractContextManager[None]:
        """Raise `Interrupted` at the first signal.

        Use this for waits, and where the exit of a context must clean up files.
        """
        return self.stop_orderly(_raise_interrupted)

    def exit_if_signalled(self) -> None:
        """If a signal was received, end the process with the exit status of that signal.

        Call this when the command has finished.
        """
        if self.number:
            for stream in (sys.stdout, sys.stderr):
                with suppress(OSError, ValueError):
                    stream.flush()
            self._reactions = [_SignalReaction(self.end_process)]
            self.end_process()

    def end_process(self) -> NoReturn:
        """Kill the children of this process, remove its racks, and end at once."""
        try:
            signal.pthread_sigmask(signal.SIG_BLOCK, {*SIGNALS, signal.SIGALRM})
            family = [
                pid
                for pid in list_descendants(os.getpid(), os.getsid(0))
                if not _is_resource_tracker(pid)
            ]
            for step in (
                partial(_kill_children, family),
                partial(_remove_racks, family),
                self._print_unfinished,
            ):
                # An error in one step must not prevent the other steps or the exit.
                with suppress(Exception):
                    step()
        finally:
            os._exit(128 + self.number)

    def _print_unfinished(self) -> None:
        """Restore the cursor of the terminal, and print the message about unfinished work."""
        if os.isatty(1):
            os.write(1, SHOW_CURSOR)
        if unfinished := self._reactions[-1].unfinished:
            os.write(2, f"{unfinished}\n".encode())

    def _handle_signal(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal. The second one ends the process at once."""
        if number == signal.SIGHUP:
            _leave_terminal()
        if self.number:
            self.end_process()
        self.number = number
        signal.setitimer(signal.ITIMER_REAL, BOUND_S)
        self._reactions[-1].stop()


INTERRUPT = Interrupt()
"""The only instance, because signals belong to the process."""


def _is_resource_tracker(pid: int) -> bool:
    """Return whether a process is Python's resource tracker.

    The tracker must not be killed: after this process has ended, it removes the semaphores of
    process pools.
    """
    with suppress(OSError):
        return b"multiprocessing.resource_tracker" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False


def _raise_interrupted() -> None:
    """Raise `Interrupted`, as the reaction to a signal."""
    raise Interrupted


def _leave_terminal() -> None:
    """Redirect terminal output to /dev/null, because writing to a closed terminal fails."""
    for fd in (1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(fd).st_mode):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, fd)
                os.close(nowhere)


def _kill_children(family: list[int]) -> None:
    """Kill the given descendants of this process, and wait until they have ended.

    A viewer window is not among them, because it has its own session, and stays open.
    """
    for pid in family:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    await_ends(family, CHILDREN_END_S)


def await_ends(pids: Iterable[int], bound_s: float) -> None:
    """Wait until all processes have ended, for at most `bound_s` in total."""
    deadline = time.monotonic() + bound_s
    for pid in pids:
        with suppress(ProcessLookupError):
            end = os.pidfd_open(pid)
            waiting = select.poll()
            waiting.register(end, select.POLLIN)
            waiting.poll(max(0.0, deadline - time.monotonic()) * 1000)
            os.close(end)


def list_descendants(pid: int, session: int | None = None) -> Iterator[int]:
    """Yield the descendants of a process, the youngest generation first.

    Args:
        pid: The process.
        session: Only processes of this session. None for all.
    """
    # A process may end before its files are read.
    children: list[int] = []
    with suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            children += map(int, (thread / "children").read_text().split())
    for child in children:
        with suppress(OSError):
            if session is None or os.getsid(child) == session:
                yield from list_descendants(child, session)
                yield child


def _remove_racks(killed: list[int]) -> None:
    """Remove the racks of this process and of its `killed` children."""
    # Look the module up instead of importing it: a signal handler may run in the middle of an
    # import. If it is not loaded, this process has not made any racks.
    remove_own = getattr(sys.modules.get("rack.boards.crate.clean"), "remove_own_racks", None)
    if remove_own is not None:
        remove_own(killed=killed)
