"""The `rack` command of this tree and of another checkout, to run both alternately in a bench.

A checkout runs in its own environment, TREE/.venv, with its own packages and libraries. `make run`
in the checkout creates this environment.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.harness import run_program

THIS_TREE = "this tree"
RUN_RACK = "import sys; from rack.tools.cli import main; sys.argv[0] = 'rack'; sys.exit(main())"
PRINT_TREE = (
    "from pathlib import Path; import rack.tools.cli as cli;"
    " print(Path(cli.__file__).resolve().parents[1])"
)
PRINT_TREE_TIMEOUT_S = 30.0
ENVIRONMENT_TARGET = ".venv/installed"
MODULE_VARIABLES = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
"""Environment variables through which a process would find modules of this environment."""


@dataclass(frozen=True)
class RackCommand:
    """The `rack` command of one tree.

    Attributes:
        name: Name of the tree.
        argv: Program and arguments that precede the arguments of `rack`.
        environment: All environment variables of the command.
    """

    name: str
    argv: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=os.environ.copy)

    def run(self, *arguments: object, bound_s: float) -> str:
        """Run a command to its end and return its stdout.

        Args:
            arguments: Arguments of `rack`.
            bound_s: Longest permitted time, s.

        Raises:
            Failure: If it fails or takes too long. The text contains the last line of its stderr.
        """
        label = f"{self.name}: rack {' '.join(map(str, arguments[:2]))}"
        argv = [*self.argv, *map(str, arguments)]
        completed = run_program(label, argv, bound_s, self.environment)
        if completed.returncode:
            lines = filter(str.strip, completed.stderr.splitlines())
            messages = [f"exit status {completed.returncode}", *lines]
            raise Failure(f"{label}: {messages[-1]}")
        return completed.stdout


def build_rack_commands(against: Path | None) -> list[RackCommand]:
    """Return the command of this tree, followed by the command of `against` if it is given.

    Raises:
        Failure: If `against` is not a usable checkout.
    """
    this = RackCommand(THIS_TREE, (sys.executable, "-c", RUN_RACK))
    return [this] if against is None else [this, build_checkout_command(against)]


def build_checkout_command(tree: Path) -> RackCommand:
    """Return the command of another checkout.

    Raises:
        Failure: If `tree` is not a checkout of rack, or has no environment that runs it.
    """
    if not (tree / "tools" / "cli.py").is_file():
        raise Failure(f"{tree}: is not a checkout of rack: it has no tools/cli.py", 2)
    python = tree.resolve() / ".venv" / "bin" / "python"
    if not python.is_file():
        raise Failure(
            f"{tree}: has no environment .venv; to create it: make -C {tree} {ENVIRONMENT_TARGET}",
            2,
        )
    # The working directory may be another tree. PYTHONSAFEPATH prevents imports from it.
    inherited = {name: value for name, value in os.environ.items() if name not in MODULE_VARIABLES}
    environment = {**inherited, "PYTHONSAFEPATH": "1"}
    locate = RackCommand(tree.resolve().name, (str(python), "-c", PRINT_TREE), environment)
    # An environment that was copied together with its tree still runs the original tree.
    if (actual := Path(locate.run(bound_s=PRINT_TREE_TIMEOUT_S).strip())) != tree.resolve():
        raise Failure(
            f"{tree}: its .venv belongs to {actual}; to renew it: make -C {tree} clean "
            f"{ENVIRONMENT_TARGET}",
            2,
        )
    return replace(locate, argv=(str(python), "-c", RUN_RACK))
