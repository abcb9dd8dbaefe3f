"""The `rack` command line of this tree and of another checkout, each in its own environment, so
that a bench can run both by turns."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rack.tools.console.answer import Failure

THIS = "this tree"
END_S = 1.2
"""Longest wait for a command that was asked to end."""


@dataclass(frozen=True)
class RackCommand:
    """A `rack` command line: `argv` goes before the arguments, `environment` is all of its
    environment. `name` says which tree it is of."""

    name: str
    argv: tuple[str, ...]
    environment: Mapping[str, str]

    def run(self, *arguments: object, bound_s: float) -> str:
        """Run a command to its end; return its stdout.

        Raises `Failure` with the last line of its stderr if it fails, or if it takes longer than
        `bound_s`. Ends the command, in order if it can, if this process is interrupted.
        """
        command = [*self.argv, *map(str, arguments)]
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            command, env=self.environment, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe
        )
        try:
            out, err = process.communicate(timeout=bound_s)
        except subprocess.TimeoutExpired:
            raise Failure(f"{self._shown(arguments)}: still running after {bound_s:g} s") from None
        finally:
            if process.poll() is None:
                _end(process)
        if process.returncode:
            raise Failure(
                f"{self._shown(arguments)}:"
                f" {_reason(err.decode(errors='replace'), process.returncode)}"
            )
        return out.decode(errors="replace")

    def _shown(self, arguments: tuple[object, ...]) -> str:
        return f"{self.name}: rack {' '.join(map(str, arguments[:2]))}"


def this_rack() -> RackCommand:
    """Return the command line of the tree that is running, as it is installed."""
    return RackCommand(THIS, (sys.executable, "-m", "rack.tools.cli"), os.environ.copy())


def checkout(tree: Path) -> RackCommand:
    """Return the command line of another checkout. Raises `Failure` if it is none, or has no
    environment."""
    if not (tree / "pyproject.toml").is_file():
        reason = "it has no pyproject.toml" if tree.is_dir() else "no such folder"
        raise Failure(f"{tree}: not a checkout of rack: {reason}", 2)
    program = tree.resolve() / ".venv" / "bin" / "rack"
    if not program.is_file():
        raise Failure(f"{tree}: no environment; to make it: make -C {tree} .venv/installed", 2)
    # What is on this process's path of modules is of this tree.
    own = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return RackCommand(tree.resolve().name, (str(program),), own)


def both_racks(against: Path | None) -> list[RackCommand]:
    """Return the command line of this tree, and after it that of the checkout `against`, if there
    is one."""
    return [this_rack(), *([] if against is None else [checkout(against)])]


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.communicate(timeout=END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _reason(stderr: str, status: int) -> str:
    """Return the last line of an error message."""
    lines = [line for line in stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"exit status {status}"
