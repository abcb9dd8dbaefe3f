"""The `rack` command line within the test's own process: without a second of imports for every call."""

from __future__ import annotations

import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from rack.tools.cli import run_commands

ROOT = Path(__file__).resolve().parents[2]


def rack(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command from the project's root; return what a process would have left."""
    before, out, err, status = sys.argv, StringIO(), StringIO(), 0
    sys.argv = ["rack", *map(str, arguments)]
    try:
        with chdir(ROOT), redirect_stdout(out), redirect_stderr(err):
            run_commands()
    except SystemExit as end:
        status = int(end.code or 0)
    finally:
        sys.argv = before
    return subprocess.CompletedProcess(arguments, status, out.getvalue(), err.getvalue())
