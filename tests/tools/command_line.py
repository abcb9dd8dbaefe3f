"""Runs the `rack` command line inside the test process, which saves a second of imports."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from rack.boards.crate import patience
from rack.levels import references
from rack.tools.cli import run_commands
from rack.tools.console import progress
from rack.tools.console.answer import Failure
from tests.processes import RACK
from tests.warm import Popen

ROOT = Path(__file__).resolve().parents[2]
BOUND_S = 100
"""Bound of a command that a test starts as a process: for its signals, or to go on while it
runs."""


def rack(*arguments: object, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run a command from a folder, by default the project's, and return a completed process.

    On a slow machine, too, it does not say how far it is, or what its launch waits for.
    """
    before, out, err, status = sys.argv, StringIO(), StringIO(), 0
    sys.argv = ["rack", *map(str, arguments)]
    try:
        with (
            pytest.MonkeyPatch.context() as patch,
            chdir(folder),
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            patch.setattr(patience, "PATIENCE_S", BOUND_S)
            patch.setattr(references, "SLOW_S", references.MAX_IMPORT_S)
            patch.setattr(progress, "LINE_INTERVAL_S", BOUND_S)
            run_commands()
    except SystemExit as end:
        status = int(end.code or 0)
    finally:
        sys.argv = before
    return subprocess.CompletedProcess(arguments, status, out.getvalue(), err.getvalue())


@contextmanager
def started(*words: object, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Start a command as a process with pipes, which is killed at the end, should it still run."""
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    given = {"cwd": ROOT, "text": True, **pipes, **options}
    process: subprocess.Popen[str] = Popen([*RACK, *map(str, words)], **given)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def read_answer(*arguments: object, status: int = 0, folder: Path = ROOT) -> Any:
    """Run a command with --json, and return its document. Fails on another exit status."""
    done = rack(*arguments, "--json", folder=folder)
    assert done.returncode == status, done.stderr
    return json.loads(done.stdout)


def read_refusal(done: subprocess.CompletedProcess[str], status: int = 2) -> str:
    """Return the line of a refused command. Fails if it prints more or has another exit status."""
    (line,) = done.stderr.splitlines()
    assert (done.returncode, done.stdout, done.stderr) == (status, "", f"{line}\n")
    return line


def read_failure(call: Callable[..., object], *arguments: object) -> str:
    """Return the line with which a call fails. Its exit status must be 2."""
    with pytest.raises(Failure) as caught:
        call(*arguments)
    (line,) = str(caught.value).splitlines()
    assert caught.value.status == 2
    return line
