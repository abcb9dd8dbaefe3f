"""The recorder process as its launcher sees it: spawned, never forked, so that no board inherits its threads."""

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
"""Printed by the recorder when it has attached."""
ATTACH_S = 30.0
"""Longest wait for the recorder to begin."""
FINISH_S = 20.0
"""Longest wait for its end; what it has not written by then is in its spool."""
LOOK_S = 0.2
RESTARTS = 3
FREED = "the recorder does not keep up: the run no longer waits for it"


class RecorderProcess:
    """A recorder for a rack that is about to run; it imports its libraries while the rack is being launched.

    The run continues whatever happens to it. A recorder that dies is restarted up to RESTARTS times, in the same
    folder.
    """

    def __init__(self) -> None:
        # stderr goes to a file in memory: nobody would empty a pipe.
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
        """Record that rack into that folder, and serve a viewer on that port; return False if it has not begun in time.

        With the rack's `words`, `news` reports when a rack in lockstep no longer waits for it.
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

    def news(self) -> list[str]:
        """Return messages for the user since the last call, including the recorder's early end."""
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
        """Restart it, unless it has died too often; return the message for the user."""
        ended = f"the recorder ended with status {self._process.returncode}{self._complaint()}"
        if self._restarts == RESTARTS:
            self._is_gone = True
            self._set_follower(0)
            return f"{ended}; the run continues, unrecorded"
        self._restarts += 1
        self._is_waited_for = False
        self._close_pipes()
        self._start()
        self._ask()
        # The clock waits for it as it did for the first one: the rings hold what it needs.
        self._set_follower(self.pid)
        return f"{ended}; restarted, {self._restarts} of at most {RESTARTS} times"

    def _set_follower(self, pid: int) -> None:
        if self._words is not None and self._words[System.LOCKSTEP]:
            self._words[System.FOLLOWER_PID] = pid

    def finish(self, in_a_hurry: bool = False) -> str:
        """Let it record what is left and finish its files; return "complete", or why the recording is not.

        In a hurry it does without the viewer's file if it has not begun that one yet.
        """
        if not self._result:
            if self._process.stdin is not None:
                with suppress(BrokenPipeError):
                    self._process.stdin.write(b"hurry\n" if in_a_hurry else b"")
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
            # A stopped process would never end.
            if time.monotonic() > deadline or state_of(self.pid) in STOPPED:
                self._process.kill()

    def _close_pipes(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()

    def _complaint(self) -> str:
        """Return the last line it printed on stderr."""
        size = os.fstat(self._complaints).st_size
        last = os.pread(self._complaints, 4096, max(0, size - 4096)).decode(errors="replace").strip().splitlines()[-1:]
        return "".join(f": {line}" for line in last)

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
