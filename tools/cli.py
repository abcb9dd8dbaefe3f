"""The `rack` command line.

A command's module is imported only when that command runs or shows its help. The parser, typer,
takes long to import, so `rack run` starts its crate first.
"""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from io import StringIO, TextIOBase
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from rack.tools.console.interrupt import INTERRUPT, Interrupted

if TYPE_CHECKING:
    import typer
    from typer.core import TyperGroup

    from rack.boards.crate.line import CrateLine


COMMANDS = {
    "Run": {
        "run": "Run a rack until its task ends, and report on the run.",
        "stop": "End a run and wait until it is gone.",
        "pause": "Pause a rack, or the motion of its arm.",
        "resume": "Let a paused rack continue.",
        "step": "Advance a rack in lockstep by single cycles.",
        "rewind": "Go back to any tick of a recorded run, and branch off.",
        "list": "List the racks on this machine.",
        "clean": "Remove the shared memory that killed racks left behind.",
    },
    "Watch": {
        "status": "Show a running rack once.",
        "top": "Watch a running rack until its end.",
        "watch": "Plot live signals, or capture a window around a trigger.",
        "mailbox": "Show the newest message in a mailbox of a running rack.",
        "record": "Record a running rack.",
        "replay": "Open recordings in the viewer, several racks on one time line.",
        "plot": "Plot signals of a run, or of a running rack.",
        "picture": "Draw a view of a recorded run, without a screen.",
        "export": "Write a recorded run as MCAP, rosbag2 or Perfetto.",
        "report": "Report on a recorded run, or compare two runs.",
        "bridge": "Connect a running rack to ROS 2 or Foxglove.",
    },
    "Command and disturb": {
        "command": "Command one level of a running rack.",
        "set": "Set a live parameter of a running rack.",
        "prompt": "Open a Python prompt on the host side of a rack.",
        "estop": "Engage the brakes of the arm at once, until --reset.",
        "inject": "Inject a fault into a running rack.",
        "campaign": "Inject random faults into many runs, and judge each.",
    },
    "Predict": {
        "check": "Validate a config and predict its timing.",
        "analyze": "Compare a run with the timing model, equation by equation.",
        "gantt": "Draw a Gantt chart of a config's schedule, or of a run.",
    },
    "Compare": {
        "bench": "Measure costs on this machine.",
        "reproduce": "Reproduce the paper, claim by claim, as one page.",
    },
    "Bring up": {
        "new": "Write a level, a servo law or a planner to start from.",
        "robot": "Bring up any arm, from a model file.",
    },
    "Reach others": {
        "lan": "Make certificates for racks on a network.",
    },
    "Look up": {
        "schema": "Show the keys of a config with their units and defaults.",
    },
}
"""All commands with one line of help, grouped by purpose."""
COMMAND_SOURCES = {
    "resume": "rack.tools.commands.pause:resume",
    "list": "rack.tools.commands.list:list_racks",
    "set": "rack.tools.commands.command:set_param",
    "robot": "rack.tools.commands.robot:app",
    "lan": "rack.tools.network.group:app",
}
"""Sources of commands, as "module:attribute" of a function or a `typer.Typer`.

A command that is not listed is the function of the same name in the module of that name.
"""
MAX_ARGUMENT = 4096
"""Maximum length of an argument, the same as of a path. Longer values belong in the config."""
COMPLETION_VARIABLE = "_RACK_COMPLETE"
"""Environment variable that a shell sets to request the completion of a command line."""
USAGE_ERRORS = (
    errno.ENAMETOOLONG,
    errno.ENOENT,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.ELOOP,
    errno.EACCES,
)
"""System errors that indicate a wrong path given by the user."""


def main() -> None:
    """Run the command line. Mistakes of the user are reported in one line."""
    if sys.platform != "linux":
        sys.exit(
            f"rack runs only on Linux, not on {sys.platform}: it needs /dev/shm, pidfds and"
            " SCHED_FIFO"
        )
    # Handle signals before anything else: imports take longer than many commands.
    INTERRUPT.install_handlers()
    _open_closed_streams()
    try:
        try:
            run_commands()
        except OSError:
            # If stdout is the cause, this call exits. It prints nothing if the pipe is closed.
            _flush_stdout("\n")
            raise
        finally:
            _flush_stdout()
    except Interrupted:
        return
    finally:
        INTERRUPT.exit_if_signalled()


class ClosedInput(TextIOBase):
    """A stdin that was closed before the program started."""

    def fileno(self) -> int:
        """Return a descriptor that is always readable."""
        return 0

    def readline(self, size: int | None = -1, /) -> str:  # type: ignore[override]
        """Raise `Failure`, because there is no input."""
        from rack.tools.console.answer import Failure

        raise Failure("stdin is closed, and this command reads from it", 2)


def _open_closed_streams() -> None:
    """Open closed standard streams on /dev/null.

    Otherwise the next file to be opened would get the descriptor of a standard stream, and printed
    text would end up in that file.
    """
    # `os.open` returns the lowest free descriptor, which is that of the first closed stream.
    if sys.stdin is None:
        os.open(os.devnull, os.O_RDONLY)
        sys.stdin = ClosedInput()
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_WRONLY), "w"))


def run_commands() -> None:
    """Run the command line in this process, without handling signals."""
    from rack.tools.console.answer import Failure, convert_errors, exit_with_failure

    arguments = sys.argv[1:]
    if sys.flags.optimize > 1 and "--help" in arguments:
        print("help lacks its texts: PYTHONOPTIMIZE=2 (python -OO) removes them", file=sys.stderr)
    try:
        _check_arguments(arguments)
        with convert_errors(), _start_crate_early(arguments) as crate:
            sys.exit(build_commands()(prog_name="rack", obj=crate, standalone_mode=False))
    except Failure as failure:
        exit_with_failure(str(failure), failure.status)
    except OSError as error:
        _fail_on_system_error(error)
    except Exception as error:
        # Recognise the parser's usage errors by their method `show`, without importing their class.
        if not hasattr(error, "show"):
            raise
        error.show(usage := StringIO())
        exit_with_failure(usage.getvalue().rstrip(), 2)


def _fail_on_system_error(error: OSError) -> NoReturn:
    """Exit with a one-line message about a system error.

    Re-raises an error that neither the user's input nor a resource limit explains.
    """
    from rack.backplane.process import describe_refusal
    from rack.boards.errors import format_value
    from rack.tools.console.answer import exit_with_failure

    if error.filename is not None:
        status = 2 if error.errno in USAGE_ERRORS else 1
        exit_with_failure(f"{format_value(str(error.filename))}: {error.strerror}", status)
    if Path("/proc/self/cwd").readlink().name.endswith(" (deleted)"):
        exit_with_failure("the working folder has been removed; change to another one", 2)
    if error.errno not in (errno.EAGAIN, errno.EMFILE):
        raise error
    exit_with_failure(describe_refusal(error), 1)


def _flush_stdout(text: str = "") -> None:
    """Print a text, and flush stdout."""
    try:
        print(end=text, flush=True)
    except OSError as error:
        # Otherwise the interpreter's own flush at exit would print a traceback.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        # A reader that has closed the pipe needs no message.
        if error.errno != errno.EPIPE:
            print(f"stdout: {error.strerror}", file=sys.stderr)
        sys.exit(1)


def _start_crate_early(arguments: Sequence[str]) -> AbstractContextManager[CrateLine | None]:
    """Start the crate of `rack run`, so that its slow imports run on another core.

    The returned context provides the crate, or None for any other command.
    """
    if (
        arguments[:1] != ["run"]
        or len(arguments) == 1
        or "--help" in arguments
        or COMPLETION_VARIABLE in os.environ
    ):
        return nullcontext()
    from rack.boards.crate.line import LIBRARIES, CrateLine, WarmCrate

    os.environ.update(LIBRARIES)
    return (
        WarmCrate() if any(argument.startswith("--from") for argument in arguments) else CrateLine()
    )


def build_commands() -> TyperGroup:
    """Build the command line. Each command is imported only when it is used."""
    import typer
    from typer.core import TyperCommand, TyperGroup

    class Grouped(TyperGroup):
        """Command group whose help lists the commands by purpose."""

        def format_commands(self, ctx: Any, formatter: Any) -> None:
            """Write a table of the commands for each group."""
            for group, group_commands in COMMANDS.items():
                with formatter.section(group):
                    formatter.write_dl(
                        [(f"{name:9}", line) for name, line in group_commands.items()]
                    )

    class LazyCommand(TyperCommand):
        """Command that is imported on use. Until then only its name and help line are known."""

        def make_context(self, *given: Any, **named: Any) -> Any:
            """Import the real command, and create its context instead."""
            return _load_command(str(self.name)).make_context(*given, **named)

    def show_version(is_asked: bool) -> None:
        """Print the version and exit, if --version was given."""
        from importlib.metadata import version

        if is_asked:
            print(f"rack {version('nasrem-rack')}")
            raise typer.Exit

    def rack(
        version: bool = typer.Option(
            False,
            "--version",
            help="Show the version and exit.",
            callback=show_version,
            is_eager=True,
        ),
    ) -> None:
        """Declare the options that precede the command."""

    app = _create_app(
        cls=Grouped,
        add_completion=True,
        no_args_is_help=True,
        help=(
            "Run, watch and command racks: crates of boards, one process each, under a common"
            " clock."
        ),
        epilog=(
            "Exit status: 0 success, 1 failure, 2 usage or config error, 128 + N ended by signal N."
        ),
    )
    app.callback()(rack)
    group = typer.main.get_command(app)
    assert isinstance(group, TyperGroup), "it has a callback"
    for name, line in chain.from_iterable(
        group_commands.items() for group_commands in COMMANDS.values()
    ):
        group.add_command(LazyCommand(name, short_help=line))
    return group


def _create_app(add_completion: bool = False, **settings: Any) -> typer.Typer:
    """Create a typer application with plain-text help."""
    import typer

    return typer.Typer(add_completion=add_completion, rich_markup_mode=None, **settings)


def _load_command(name: str) -> Any:
    """Import a command by its name."""
    import typer

    source = COMMAND_SOURCES.get(name, f"rack.tools.commands.{name}:{name}")
    path, _, attribute = source.partition(":")
    command = getattr(import_module(path), attribute)
    if not isinstance(command, typer.Typer):
        app = _create_app()
        app.command(name)(command)
        command = app
    return typer.main.get_command(command)


def _check_arguments(arguments: list[str]) -> None:
    """Raise `Failure` for an argument that is too long or not UTF-8."""
    from rack.boards.errors import format_value
    from rack.tools.console.answer import Failure

    for at, argument in enumerate(arguments, 1):
        if len(argument) > MAX_ARGUMENT:
            raise Failure(
                f"argument {at} = {format_value(argument)}: has {len(argument)} "
                "characters; must be at"
                f" most {MAX_ARGUMENT}",
                2,
            )
        if any("\ud800" <= c <= "\udfff" for c in argument):
            raise Failure(f"argument {at} = {format_value(argument)}: must be UTF-8", 2)


if __name__ == "__main__":
    main()
