"""The `rack` command line, as a process and, for refusals that start nothing, within the test's own process."""

from __future__ import annotations

import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from rack.tools.cli import run_commands
from tests.processes import RACK

ROOT = Path(__file__).resolve().parents[2]
BOUND_S = 50


def rack(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command as a process."""
    command = [*RACK, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=BOUND_S, check=False)


def refused(*arguments: str) -> tuple[int, str, str]:
    """Run a command that must end by `sys.exit`, in this process; return its exit status, stdout and stderr."""
    before, out, err = sys.argv, StringIO(), StringIO()
    sys.argv = ["rack", *arguments]
    try:
        with redirect_stdout(out), redirect_stderr(err):
            run_commands()
    except SystemExit as end:
        return int(end.code or 0), out.getvalue(), err.getvalue()
    finally:
        sys.argv = before
    raise AssertionError(f"{arguments}: not refused")
