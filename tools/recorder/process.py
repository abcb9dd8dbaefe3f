"""The launcher's end of a recorder: spawned, never forked, so that no board shares its threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from rack.backplane.process import STOPPED, readable, state_of
from rack.backplane.words import System

BEGUN = "recording"
"""What it says when it has attached."""
ATTACH_S = 30.0
"""Longest that a run waits for its recorder to begin."""
FINISH_S = 20.0
"""Bound of its end; what it has not written by then is in its spool."""
LOOK_S = 0.2
RESTARTS = 3
FREED = "the recorder does not keep up: the run goes on without waiting for it"


class RecorderProcess:
    """A recorder for a rack that is about to run. It imports its libraries while the rack is being launched.

    Whatever becomes of it the run goes on: one that dies is started again, RESTARTS times, and goes on in its folder.
    """

    def __init__(self) -> None:
        # A file in memory: what libraries complain of must not fill a pipe that nobody empties.
        self._complaints = os.memfd_create("recorder")
        self._request = b""
        self._words: memoryview | None = None
        self._restarts = 0
        self._result = ""
        self._is_waited_for = False
        self._start()

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rack.tools.recorder"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        self._unread = b""
        self._lines: list[str] = []
        self._has_begun = False
        self._is_gone = False

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._process.pid

    def attach(self, rack: str, folder: Path, port: int | None = None, words: memoryview | None = None) -> bool:
        """Have it record that rack into that folder, and serve a viewer on that port; False when it has not begun yet.

        With the rack's `words`, `told` says when a rack in lockstep does not wait for it any more.
        """
        self._request, self._words = json.dumps([rack, str(folder), port]).encode() + b"\n", words
        self._ask()
        deadline = time.monotonic() + ATTACH_S
        while not self._has_begun:
            if not self._read(deadline - time.monotonic()):
                return False
        self._is_waited_for = True
        return True

    def _ask(self) -> None:
        assert self._process.stdin is not None, "it is a pipe"
        with suppress(BrokenPipeError):
            self._process.stdin.write(self._request)
            self._process.stdin.flush()

    def told(self) -> list[str]:
        """Return what the user should know of the recorder since the last call; its early end, too."""
        had_begun = self._has_begun
        while not self._is_gone and self._read(0.0):
            continue
        lines, self._lines = self._lines, []
        if self._has_begun and not had_begun:
            lines.append("the recorder has begun")
            self._is_waited_for = True
        if not self._is_gone and self._process.poll() is not None:
            lines.append(self._end_early())
        elif self._is_waited_for and self._is_freed:
            self._is_waited_for = False
            lines.append(FREED)
        return lines

    @property
    def _is_freed(self) -> bool:
        words = self._words
        return words is not None and words[System.LOCKSTEP] == 1 and words[System.FOLLOWER_PID] != self.pid

    def _end_early(self) -> str:
        """Start it again, where it may be; return what the user should know of that."""
        ended = f"the recorder ended with status {self._process.returncode}{self._complaint()}"
        if self._restarts == RESTARTS:
            self._is_gone = True
            self._have_waited_for(0)
            return f"{ended}; the rack runs on, unrecorded"
        self._restarts += 1
        self._is_waited_for = False
        self._close_pipes()
        self._start()
        self._ask()
        # The clock waits for it as for the first one: the rings hold what it needs.
        self._have_waited_for(self.pid)
        return f"{ended}; restarted, {self._restarts} of at most {RESTARTS} times"

    def _have_waited_for(self, pid: int) -> None:
        if self._words is not None and self._words[System.LOCKSTEP]:
            self._words[System.FOLLOWER_PID] = pid

    def finish(self) -> str:
        """Let it take over what is left and finish its files; return "complete", or why the recording is not."""
        if not self._result:
            if self._process.stdin is not None:
                with suppress(BrokenPipeError):
                    self._process.stdin.close()
            self._await_end(time.monotonic() + FINISH_S)
            status = self._process.returncode
            self._result = "complete" if status == 0 else f"the recorder ended with status {status}{self._complaint()}"
            if self._process.stdout is not None:
                self._lines += (self._unread + self._process.stdout.read()).decode(errors="replace").splitlines()
            self._is_gone, self._is_waited_for = True, False
            self._close_pipes()
            os.close(self._complaints)
        return self._result

    def _await_end(self, deadline: float) -> None:
        while self._process.poll() is None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(LOOK_S)
            # One that is stopped comes to no end.
            if time.monotonic() > deadline or state_of(self.pid) in STOPPED:
                self._process.kill()

    def _close_pipes(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()

    def _complaint(self) -> str:
        """Return the last line that it has printed on stderr."""
        size = os.fstat(self._complaints).st_size
        last = os.pread(self._complaints, 4096, max(0, size - 4096)).decode(errors="replace").strip().splitlines()[-1:]
        return "".join(f": {line}" for line in last)

    def _read(self, timeout_s: float) -> bool:
        """Take what it has printed; False when there is nothing within the time, or its output has ended."""
        stdout = self._process.stdout
        if stdout is None or not readable(stdout.fileno(), timeout_s):
            return False
        block = os.read(stdout.fileno(), 1 << 16)
        *lines, self._unread = (self._unread + block).split(b"\n")
        told = [line.decode(errors="replace") for line in lines]
        self._has_begun |= BEGUN in told
        self._lines += [line for line in told if line != BEGUN]
        return bool(block)
