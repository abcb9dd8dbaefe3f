"""The launcher's end of a recorder: spawned, never forked, so that no board shares its threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from backplane.process import readable

PROJECT = Path(__file__).resolve().parents[2]
ATTACH_S = 30.0
FINISH_S = 120.0


class RecorderProcess:
    """A recorder for a rack that is about to run. It imports its libraries while the rack is being launched."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tools.recorder"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(PROJECT), *sys.path])},
        )
        self._printed = b""
        self._unread = b""
        self._lines: list[str] = []
        self._end_is_told = False

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._process.pid

    def attach(self, rack: str, folder: Path, port: int | None = None) -> bool:
        """Have it record that rack into that folder, and serve a viewer on that port; False when it cannot."""
        stdin = self._process.stdin
        if stdin is None:
            return False
        try:
            stdin.write(json.dumps([rack, str(folder), port]).encode() + b"\n")
            stdin.flush()
        except BrokenPipeError:
            return False
        deadline = time.monotonic() + ATTACH_S
        while "recording" not in self._lines:
            if not self._read(deadline - time.monotonic()):
                return False
        self._lines.remove("recording")
        return True

    def told(self) -> list[str]:
        """Return what the user should know of the recorder since the last call; its early end, too."""
        while self._process.returncode is None and self._read(0.0):
            continue
        lines, self._lines = self._lines, []
        if self._process.returncode is None and self._process.poll() is not None and not self._end_is_told:
            self._end_is_told = True
            lines.append(f"the recorder ended with status {self._process.returncode}; the rack runs on, unrecorded")
        return lines

    def finish(self) -> str:
        """Let it take over what is left and finish its files; return "complete", or why the recording is not."""
        if not self._printed and self._process.stdin is not None and not self._process.stdin.closed:
            try:
                rest, self._printed = self._process.communicate(timeout=FINISH_S)
                self._lines += (self._unread + rest).decode(errors="replace").splitlines()
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.communicate()
        status = self._process.returncode
        last = self._printed.decode(errors="replace").strip().splitlines()[-1:]
        return "complete" if status == 0 else ": ".join([f"the recorder ended with status {status}", *last])

    def _read(self, timeout_s: float) -> bool:
        """Take what it has printed; False when there is nothing within the time, or its output has ended."""
        stdout = self._process.stdout
        if stdout is None or not readable(stdout.fileno(), timeout_s):
            return False
        block = os.read(stdout.fileno(), 1 << 16)
        *lines, self._unread = (self._unread + block).split(b"\n")
        self._lines += [line.decode(errors="replace") for line in lines]
        return bool(block)
