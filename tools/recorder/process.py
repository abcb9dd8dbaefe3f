"""The launcher's end of a recorder: spawned, never forked, so that no board shares its threads."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
from pathlib import Path

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

    def attach(self, rack: str, folder: Path) -> bool:
        """Have it record that rack into that folder; False when it cannot."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            return False
        try:
            stdin.write(json.dumps([rack, str(folder)]).encode() + b"\n")
            stdin.flush()
        except BrokenPipeError:
            return False
        return bool(select.select([stdout], [], [], ATTACH_S)[0]) and stdout.readline().strip() == b"recording"

    def finish(self) -> str:
        """Let it take over what is left and finish its files; return "complete", or why the recording is not."""
        if self._process.returncode is None:
            try:
                self._printed = self._process.communicate(timeout=FINISH_S)[1]
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.communicate()
        status = self._process.returncode
        last = self._printed.decode(errors="replace").strip().splitlines()[-1:]
        return "complete" if status == 0 else ": ".join([f"the recorder ended with status {status}", *last])
