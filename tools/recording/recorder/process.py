"""The launcher's side of the recorder process: start, supervision, restart and end.

The recorder is spawned, never forked, so that no board inherits its threads.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any

from rack.backplane.json_text import encode_json
from rack.backplane.process import STOPPED_STATES, read_processor_ns, read_state, wait_readable
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.console.answer import Failure
from rack.tools.recording.file_names import CONFIG

VIEW_CLASS = "rack.tools.viewer.sink:ViewSink"
"""Class that writes the viewer's file.

It is given by name, because recording itself needs none of its libraries.
"""
ATTACHED_LINE = "recording"
"""Line that the recorder prints once it has attached."""
ATTACH_S = 30.0
"""Longest time to wait for the recorder to attach."""
MAX_IDLE_CHECKS = 100
MAX_STOPPED_CHECKS = 5
"""Number of consecutive idle checks after which a recorder is killed.

A check finds the recorder idle if it has used no processor time since the previous check, 0.2 s to
1 s earlier. On a busy machine a recorder is slow but never idle. The smaller number applies to a
recorder that a signal has stopped. The limits count checks, not seconds, because Ctrl-Z stops both
the recorder and the launcher that checks it.
"""
CHECK_PERIOD_S = 0.2
"""Shortest time between two checks of the recorder."""
MAX_RESTARTS = 3
UNWRITABLE = os.EX_IOERR
"""Exit status of a recorder whose files cannot be written, for example because the disk is full.

It is not restarted, since another recorder would fail as well.
"""

END_CLAUSE = "the recording ends at tick"
"""Text in the line with which a recorder reports that its files cannot be written.

The viewer's library may print more lines after that line.
"""


def format_write_failure(folder: Path, error: OSError, tick: int) -> str:
    """Return a sentence with the reason why the recording ended before the run.

    Args:
        folder: Folder of the run.
        error: Error that was raised while writing.
        tick: Tick up to which the recording is complete.
    """
    # Error messages of pyarrow are long, so prefer the standard text of the error number.
    why = os.strerror(error.errno) if error.errno else error
    return f"{folder}: {why}: {END_CLAUSE} {tick}"


class IdleCounter:
    """Counts consecutive checks that found a process idle, that is, without processor use."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._used_ns = 0
        self._count = 0

    def count_idle_checks(self) -> int:
        """Check whether the process used processor time since the last call.

        Returns:
            Number of consecutive idle checks, including this one. 0 if the process was active.
        """
        used_ns = read_processor_ns(self._pid)
        self._count = self._count + 1 if used_ns == self._used_ns else 0
        self._used_ns = used_ns
        return self._count


def start_recorder(
    segment: Segment, folder: Path, port: int | None = None, words: memoryview | None = None
) -> RecorderProcess:
    """Start recording a running rack into a folder.

    Args:
        segment: Segment of the rack.
        folder: Run folder, created if missing.
        port: As in `RecorderProcess.attach`.
        words: As in `RecorderProcess.attach`.

    Raises:
        Failure: The folder cannot be written, or the recorder does not start.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / CONFIG).write_text(segment.config)
    except OSError as error:
        if error.filename is not None:
            raise
        raise Failure(f"{folder}: {error.strerror}") from None
    recorder = RecorderProcess(folder)
    if not recorder.attach(segment.layout.rack, port, words):
        recorder.finish()
        raise Failure(f"{folder}: the recorder has not begun")
    return recorder


class RecorderProcess:
    """Starts and supervises the recorder of a rack that is about to run.

    The recorder process starts at once and imports its libraries while the rack is being launched.
    `attach` makes it record. A recorder that dies is restarted in the same folder, up to
    `MAX_RESTARTS` times, and a recorder that hangs is killed and restarted. In lockstep the clock
    waits for the recorder. If its files cannot be written, `read_notices` and `finish`
    raise `Failure`.

    Attributes:
        folder: Folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # stderr goes to a file in memory, because nobody would empty a pipe.
        self._complaints = os.memfd_create("recorder")
        self._request = b""
        self._words: Any = {}
        self._restarts = 0
        self._result: str | None = None
        self._start()

    def _start(self) -> None:
        """Spawn a recorder process and reset everything known about the previous one."""
        self._line, far_end = socket.socketpair()
        with far_end:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "rack.tools.recording.recorder", VIEW_CLASS],
                stdin=far_end.fileno(),
                stdout=far_end.fileno(),
                stderr=self._complaints,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            )
        self._unread = b""
        self._lines: list[str] = []
        self._has_begun = False
        self._is_gone = False
        self._is_killed = False
        self._idle = IdleCounter(self.pid)

    @property
    def pid(self) -> int:
        """Process id of the recorder."""
        return self._process.pid

    def attach(self, rack: str, port: int | None, words: memoryview | None = None) -> bool:
        """Make the recorder attach to a rack and record it.

        Args:
            rack: Name of the rack.
            port: Port on which the recorder serves a viewer, or None.
            words: Words of the rack's segment. The recorder's process id is written there, so that
                the clock of a rack in lockstep waits for it. None if the clock need not wait.

        Returns:
            True if the recorder has attached within `ATTACH_S`.
        """
        self._request = encode_json([rack, str(self.folder), port]).encode() + b"\n"
        self._words = {} if words is None else words
        self._send_request()
        return self.wait_until_attached(ATTACH_S)

    def wait_until_attached(self, bound_s: float = inf) -> bool:
        """Wait up to `bound_s` for the recorder to attach. Returns early if it dies.

        Returns:
            True if the recorder has attached.
        """
        deadline = time.monotonic() + bound_s
        while not self._has_begun and time.monotonic() < deadline and self._process.poll() is None:
            self._read_output(CHECK_PERIOD_S)
            self._kill_hung()
        return self._has_begun

    def _send_request(self) -> None:
        """Send the name of the rack, the folder and the viewer's port to the recorder."""
        # Make the clock wait for the recorder before it attaches, so that no row in the rings is
        # overwritten before the recorder reads it.
        self._words[System.FOLLOWER_PID] = self.pid
        with suppress(OSError):
            self._line.sendall(self._request)

    def read_notices(self) -> list[str]:
        """Return new messages for the user, and restart the recorder if it died.

        Raises:
            Failure: The files of the recording cannot be written.
        """
        had_begun = self._has_begun
        if not self._is_gone:
            self._kill_hung()
        while not self._is_gone and self._read_output(0.0):
            continue
        lines = self._lines
        self._lines = []
        if self._has_begun and not had_begun:
            lines.append("the recorder has begun")
        if not self._is_gone and self._process.poll() is not None:
            lines.append(self._restart_or_give_up())
        return lines

    def _kill_hung(self) -> None:
        """Kill the recorder if it has been idle for too many consecutive checks."""
        bound = MAX_STOPPED_CHECKS if read_state(self.pid) in STOPPED_STATES else MAX_IDLE_CHECKS
        if self._idle.count_idle_checks() > bound and not self._is_killed:
            self._is_killed = True
            self._lines.append("the recorder did not respond and was killed")
            self._process.kill()

    def _restart_or_give_up(self) -> str:
        """Restart a dead recorder unless it has been restarted `MAX_RESTARTS` times.

        Returns:
            A message to the user.

        Raises:
            Failure: The files of the recording cannot be written.
        """
        ended = self._describe_end()
        if self._restarts == MAX_RESTARTS:
            self._is_gone = True
            self._words[System.FOLLOWER_PID] = 0
            return f"{ended}; the run continues without a recording"
        self._restarts += 1
        self._line.close()
        self._start()
        self._send_request()
        return f"{ended}; restarted, {self._restarts} of at most {MAX_RESTARTS} times"

    def _describe_end(self) -> str:
        """Return a text with the exit status of the recorder and its last line on stderr.

        Raises:
            Failure: The files of the recording could not be written.
        """
        size = os.fstat(self._complaints).st_size
        status = self._process.returncode
        text = os.pread(self._complaints, 4096, max(0, size - 4096)).decode(errors="replace")
        lines = text.strip().splitlines()
        if status == UNWRITABLE:
            raise Failure(next((line for line in reversed(lines) if END_CLAUSE in line), text))
        return ": ".join((f"the recorder ended with status {status}", *lines[-1:]))

    def finish(self, in_a_hurry: bool = False) -> str:
        """Let the recorder read the remaining rows and finish its files, and wait for its end.

        Only the first call has an effect. Later calls return the same result.

        Args:
            in_a_hurry: Whether to omit the viewer's file if the recorder has not opened it yet.

        Returns:
            A description of how the recorder ended.

        Raises:
            Failure: The files of the recording cannot be written.
        """
        if self._result is None:
            self._result = ""
            with suppress(OSError):
                self._line.sendall(b"hurry\n" if in_a_hurry else b"")
                self._line.shutdown(socket.SHUT_WR)
            while self._process.poll() is None:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(CHECK_PERIOD_S)
                self._kill_hung()
            while self._read_output(0.0):
                continue
            was_reported = self._is_gone
            self._is_gone = True
            self._line.close()
            try:
                self._result = self._describe_end()
            finally:
                os.close(self._complaints)
            if self._process.returncode and not was_reported:
                # The parquet files may still be complete.
                self._lines.append(f"{self._result}; run.rrd may lack its end")
        return self._result

    def _read_output(self, timeout_s: float) -> bool:
        """Read what the recorder has printed on stdout, waiting for it up to `timeout_s`.

        Returns:
            True if something was read. False after the time-out, or if the output has ended.
        """
        block = b""
        if wait_readable(self._line.fileno(), timeout_s):
            # A recorder that was killed before it read its request resets the connection.
            with suppress(ConnectionResetError):
                block = self._line.recv(1 << 16)
        *lines, self._unread = (self._unread + block).split(b"\n")
        texts = [line.decode(errors="replace") for line in lines]
        self._has_begun |= ATTACHED_LINE in texts
        self._lines += [line for line in texts if line != ATTACHED_LINE]
        return bool(block)
