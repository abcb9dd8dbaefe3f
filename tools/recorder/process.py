"""The launcher's end of a recorder: spawned, never forked, so that no board shares its threads."""

from __future__ import annotations

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

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tools.recorder", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(PROJECT), *sys.path])},
        )

    def attach(self, rack: str) -> bool:
        """Have it record that rack; False when it cannot."""
        stdin, stdout = self._process.stdin, self._process.stdout
        if stdin is None or stdout is None:
            return False
        try:
            stdin.write(f"{rack}\n".encode())
            stdin.flush()
        except BrokenPipeError:
            return False
        return bool(select.select([stdout], [], [], ATTACH_S)[0]) and stdout.readline().strip() == b"recording"

    def finish(self) -> str | None:
        """Let it take over what is left and finish its files; return why the recording is bad, None when it is good."""
        try:
            _, printed = self._process.communicate(timeout=FINISH_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            return f"not finished within {FINISH_S:g} s"
        if self._process.returncode == 0:
            return None
        last = printed.decode(errors="replace").strip().splitlines()[-1:]
        return f"ended with status {self._process.returncode}{': ' + last[0] if last else ''}"
