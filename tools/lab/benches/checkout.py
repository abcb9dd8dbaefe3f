"""The `rack` command line of this tree and of another checkout, so that a bench can run both by
turns.

A checkout runs in its own environment, TREE/.venv, which `make run` in it has made: in its packages
and its libraries.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.harness import finished

THIS = "this tree"
RUN = "import sys; from rack.tools.cli import main; sys.argv[0] = 'rack'; sys.exit(main())"
WHERE = (
    "from pathlib import Path; import rack.tools.cli as cli;"
    " print(Path(cli.__file__).resolve().parents[1])"
)
WHERE_S = 30.0
ENV = ".venv/installed"
SOURCES = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
"""Variables by which a process would get modules of this environment."""


@dataclass(frozen=True)
class RackCommand:
    """A command line: `argv` goes before the arguments, `environment` is all of its environment.

    `name` says whose it is.
    """

    name: str
    argv: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=os.environ.copy)

    def run(self, *arguments: object, bound_s: float) -> str:
        """Run a command to its end; return its stdout.

        Raises `Failure` with the last line of its stderr if it fails, and as `finished`.
        """
        called = f"{self.name}: rack {' '.join(map(str, arguments[:2]))}"
        argv = [*self.argv, *map(str, arguments)]
        done = finished(called, argv, bound_s, self.environment)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if line.strip()]
            said = lines or [f"exit status {done.returncode}"]
            raise Failure(f"{called}: {said[-1]}")
        return done.stdout


def rack_commands(against: Path | None) -> list[RackCommand]:
    """Return the command line of this tree, and after it that of the checkout `against`, if there
    is one. Raises `Failure`.
    """
    this = RackCommand(THIS, (sys.executable, "-c", RUN))
    return [this] if against is None else [this, checkout(against)]


def checkout(tree: Path) -> RackCommand:
    """Return the command line of another checkout.

    Raises `Failure` if `tree` is not a checkout of rack, or has no environment.
    """
    if not (tree / "tools" / "cli.py").is_file():
        raise Failure(f"{tree}: not a checkout of rack: it has no tools/cli.py", 2)
    python = tree.resolve() / ".venv" / "bin" / "python"
    if not python.is_file():
        raise Failure(f"{tree}: no environment .venv; to make it: make -C {tree} {ENV}", 2)
    # The folder that a command starts in may be another tree: it must not come first.
    own = {name: value for name, value in os.environ.items() if name not in SOURCES}
    environment = {**own, "PYTHONSAFEPATH": "1"}
    place = RackCommand(tree.resolve().name, (str(python), "-c", WHERE), environment)
    # A copied environment runs the tree that it was copied from.
    if (found := Path(place.run(bound_s=WHERE_S).strip())) != tree.resolve():
        raise Failure(
            f"{tree}: its .venv is that of {found}; to make its own: make -C {tree} clean {ENV}", 2
        )
    return replace(place, argv=(str(python), "-c", RUN))
