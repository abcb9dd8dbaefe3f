"""The `rack` command line of this tree and of another checkout, so that a bench can run both by
turns.

A checkout runs in the environment of this process, whatever it was installed from: its own packages
come first on the path of every process it starts. What it needs and this environment lacks, a user
gives in PYTHONPATH.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rack.tools.console.answer import Failure

ENTRY = "rack.tools.cli:main"
"""This tree's own entry point."""
THIS = "this tree"
RUN = "import sys; from {module} import {function} as main; sys.argv[0] = 'rack'; sys.exit(main())"
END_S = 1.2
"""Longest wait for a command that was asked to end."""


@dataclass(frozen=True)
class RackCommand:
    """A `rack` command line: `argv` goes before the arguments, `environment` is all of its
    environment.

    `name` says which tree it is of; `package` is what its own imports begin with, "rack." or
    nothing.
    """

    name: str
    argv: tuple[str, ...]
    environment: Mapping[str, str]
    package: str

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
    return RackCommand(THIS, _argv(ENTRY), os.environ.copy(), "rack.")


@contextmanager
def checkout(tree: Path) -> Iterator[RackCommand]:
    """Give the command line of another checkout, as its pyproject.toml names it.

    Raises `Failure` if `tree` is not a checkout of rack.
    """
    project = _project(tree)
    entry = project.get("project", {}).get("scripts", {}).get("rack")
    if not isinstance(entry, str) or ":" not in entry:
        raise Failure(f"{tree}: not a checkout of rack: its pyproject.toml has no script 'rack'", 2)
    with TemporaryDirectory(prefix="rack-bench-") as links:
        path = [*_sources(tree.resolve(), project, Path(links)), os.environ.get("PYTHONPATH", "")]
        # The folder that a command starts in may be another tree: it must not come first.
        changes = {"PYTHONPATH": os.pathsep.join(filter(None, path)), "PYTHONSAFEPATH": "1"}
        package = "rack." if entry.startswith("rack.") else ""
        yield RackCommand(tree.resolve().name, _argv(entry), {**os.environ, **changes}, package)


@contextmanager
def both_racks(against: Path | None) -> Iterator[list[RackCommand]]:
    """Give the command line of this tree, and after it that of the checkout `against`, if there is
    one."""
    with ExitStack() as stack:
        others = [] if against is None else [stack.enter_context(checkout(against))]
        yield [this_rack(), *others]


def _argv(entry: str) -> tuple[str, ...]:
    module, _, function = entry.partition(":")
    return sys.executable, "-c", RUN.format(module=module, function=function)


def _project(tree: Path) -> dict[str, Any]:
    path = tree / "pyproject.toml"
    if not path.is_file():
        why = "it has no pyproject.toml" if tree.is_dir() else "no such folder"
        raise Failure(f"{tree}: not a checkout of rack: {why}", 2)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise Failure(f"{path}: {error}", 2) from None


def _sources(tree: Path, project: Mapping[str, Any], links: Path) -> Iterator[str]:
    """Yield what must be on the path of modules: the tree, and links for packages whose folders
    have other names."""
    folders = project.get("tool", {}).get("setuptools", {}).get("package-dir", {})
    for package, folder in folders.items():
        if not (tree / folder).is_dir():
            raise Failure(f"{tree}: not a checkout of rack: it has no folder {folder}", 2)
        link = links.joinpath(*package.split("."))
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(tree / folder, target_is_directory=True)
    yield str(links) if folders else str(tree)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.communicate(timeout=END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _reason(stderr: str, status: int) -> str:
    """Return the last line of an error message; for a package that is lacking, also where to give
    it."""
    last = next(
        (line for line in reversed(stderr.splitlines()) if line.strip()), f"exit status {status}"
    )
    return (
        f"{last}; give the folder that has it in PYTHONPATH"
        if last.startswith("ModuleNotFoundError")
        else last
    )
