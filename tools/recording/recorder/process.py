"""The recorder process as its launcher sees it: spawned, never forked, so that no board inherits
its threads.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from math import inf
from pathlib import Path

from rack.backplane.json_text import encode_json
from rack.backplane.process import STOPPED, processor_ns, readable, state_of
from rack.backplane.words import System
from rack.tools.console.answer import Failure

VIEW = "rack.tools.viewer.sink:ViewSink"
"""What shows a recording, by name: recording itself needs none of it."""
BEGUN = "recording"
"""Printed by the recorder when it has attached."""
ATTACH_S = 30.0
"""Longest wait for the recorder to begin."""
IDLE_LOOKS = 100
STOPPED_LOOKS = 5
"""Looks, 0.2 s to 1 s apart, at a recorder that uses no processor time, after which it is killed:
on a loaded machine it is slow, but never idle. Fewer for one that a signal has stopped. Looks, not
seconds: Ctrl-Z stops both processes.
"""
LOOK_S = 0.2
"""Shortest time between two such looks."""
RESTARTS = 3
UNWRITABLE = os.EX_IOERR
"""Exit status of a recorder whose files cannot be written, as on a full disk: another one could not
either."""

ENDS = "the recording ends at tick"
"""In the line that such a recorder prints; the viewer's library may print more after it."""


def unwritable(folder: Path, error: OSError, tick: int) -> str:
    """Return why a recording ends before its run."""
    # The text of pyarrow's own errors is long.
    why = os.strerror(error.errno) if error.errno else error
    return f"{folder}: {why}: {ENDS} {tick}"


class IdleLooks:
    """Counts the looks in a row at which a process has used no processor time."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._used_ns = 0
        self._count = 0

    def look(self) -> int:
        """Return the number of such looks, this one included; 0 if it has used some."""
        used_ns = processor_ns(self._pid)
        self._count = self._count + 1 if used_ns == self._used_ns else 0
        self._used_ns = used_ns
        return self._count


class RecorderProcess:
    """A recorder for a rack that is about to run, which records into `folder`; it imports its
    libraries while the rack is being launched.

    One that dies is restarted up to RESTARTS times, in the same folder; one that hangs is killed
    first. Lockstep waits meanwhile. If its files cannot be written, `news` and `finish` raise
    `Failure`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # stderr goes to a file in memory: nobody would empty a pipe.
        self._complaints = os.memfd_create("recorder")
        self._request = b""
        self._words: memoryview | None = None
        self._restarts = 0
        self._result: str | None = None
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rack.tools.recording.recorder", VIEW],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        self._unread = b""
        self._lines: list[str] = []
        self._has_begun = False
        self._is_gone = False
        self._is_killed = False
        self._idle = IdleLooks(self.pid)

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._process.pid

    def attach(self, rack: str, port: int | None, words: memoryview | None = None) -> bool:
        """Record that rack, and serve a viewer on that port; return False if it has not begun in
        time. With the `words` of a rack in lockstep, that waits for it, in any case.
        """
        self._request = encode_json([rack, str(self.folder), port]).encode() + b"\n"
        self._words = words
        self._ask()
        return self.await_begun(ATTACH_S)

    def await_begun(self, bound_s: float = inf) -> bool:
        """Wait until it records, dies or hangs, at most `bound_s`; return whether it has begun."""
        deadline = time.monotonic() + bound_s
        while not self._has_begun and time.monotonic() < deadline and self._process.poll() is None:
            self._read(LOOK_S)
            self._kill_hung()
        return self._has_begun

    def _ask(self) -> None:
        assert self._process.stdin is not None, "it is a pipe"
        # The clock waits for it from now on: the rings hold what it needs.
        self._set_follower(self.pid)
        with suppress(BrokenPipeError):
            self._process.stdin.write(self._request)
            self._process.stdin.flush()

    def news(self) -> list[str]:
        """Return messages for the user since the last call, including the recorder's early end."""
        had_begun = self._has_begun
        if not self._is_gone:
            self._kill_hung()
        while not self._is_gone and self._read(0.0):
            continue
        lines = self._lines
        self._lines = []
        if self._has_begun and not had_begun:
            lines.append("the recorder has begun")
        if not self._is_gone and self._process.poll() is not None:
            lines.append(self._end_early())
        return lines

    def _kill_hung(self) -> None:
        bound = STOPPED_LOOKS if state_of(self.pid) in STOPPED else IDLE_LOOKS
        if self._idle.look() > bound and not self._is_killed:
            self._is_killed = True
            self._lines.append("the recorder is not responding: killed")
            self._process.kill()

    def _end_early(self) -> str:
        """Restart it, unless it has died too often; return the message for the user."""
        ended = self._ended()
        if self._restarts == RESTARTS:
            self._is_gone = True
            self._set_follower(0)
            return f"{ended}; the run continues, unrecorded"
        self._restarts += 1
        self._close_pipes()
        self._start()
        self._ask()
        return f"{ended}; restarted, {self._restarts} of at most {RESTARTS} times"

    def _ended(self) -> str:
        """Return how it ended, with the last line that it printed on stderr."""
        size = os.fstat(self._complaints).st_size
        status = self._process.returncode
        text = os.pread(self._complaints, 4096, max(0, size - 4096)).decode(errors="replace")
        lines = text.strip().splitlines()
        if status == UNWRITABLE:
            raise Failure(next((line for line in reversed(lines) if ENDS in line), text))
        return ": ".join((f"the recorder ended with status {status}", *lines[-1:]))

    def _set_follower(self, pid: int) -> None:
        if self._words is not None:
            self._words[System.FOLLOWER_PID] = pid

    def finish(self, in_a_hurry: bool = False) -> str:
        """Let it record what is left and finish its files; return how it ended. It may be called
        again.

        In a hurry it does without the viewer's file if it has not begun that one yet.
        """
        if self._result is None:
            self._result = ""
            if self._process.stdin is not None:
                with suppress(BrokenPipeError):
                    self._process.stdin.write(b"hurry\n" if in_a_hurry else b"")
                    self._process.stdin.close()
            while self._process.poll() is None:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(LOOK_S)
                self._kill_hung()
            while self._read(0.0):
                continue
            was_reported = self._is_gone
            self._is_gone = True
            self._close_pipes()
            try:
                self._result = self._ended()
            finally:
                os.close(self._complaints)
            if self._process.returncode and not was_reported:
                # The tables may be complete all the same.
                self._lines.append(f"{self._result}; run.rrd may lack its end")
        return self._result

    def _close_pipes(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()

    def _read(self, timeout_s: float) -> bool:
        """Read what it printed; return False when nothing came in time, or its output has ended."""
        stdout = self._process.stdout
        if stdout is None or not readable(stdout.fileno(), timeout_s):
            return False
        block = os.read(stdout.fileno(), 1 << 16)
        *lines, self._unread = (self._unread + block).split(b"\n")
        texts = [line.decode(errors="replace") for line in lines]
        self._has_begun |= BEGUN in texts
        self._lines += [line for line in texts if line != BEGUN]
        return bool(block)
