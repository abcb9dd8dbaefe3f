"""The `rack` command: one file a subcommand; each imports what it needs only when it runs."""

from __future__ import annotations

import errno
import sys
from typing import TYPE_CHECKING

from rack.tools.interrupt import INTERRUPT, Interrupted

if TYPE_CHECKING:
    import typer

LONGEST_ARGUMENT = 4096
"""Characters, as in the longest path; what a config holds beyond that belongs into a file."""
USAGE = (errno.ENAMETOOLONG, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ELOOP, errno.EACCES)
"""What the system says of a path that a user should not have given."""


def commands() -> typer.Typer:
    """Return the command line."""
    import typer

    from rack.tools.analyze import analyze
    from rack.tools.bench.command import bench
    from rack.tools.campaign import campaign
    from rack.tools.check import check
    from rack.tools.clean import clean
    from rack.tools.command import EXAMPLES as COMMANDING
    from rack.tools.command import command
    from rack.tools.estop import estop
    from rack.tools.gantt import gantt
    from rack.tools.inject import EXAMPLES as INJECTING
    from rack.tools.inject import KindsCommand, inject
    from rack.tools.list import list_racks
    from rack.tools.record import record
    from rack.tools.replay import replay
    from rack.tools.report import report
    from rack.tools.run import run
    from rack.tools.schema import EXAMPLES as SCHEMA_EXAMPLES
    from rack.tools.schema import schema
    from rack.tools.status import status
    from rack.tools.stop import stop

    app = typer.Typer(
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help="Run, watch and command racks: crates of boards, one process each, under a common clock.",
        epilog="Exit status: 0 it worked, 1 it did not, 2 usage or config error, 128 + N ended by signal N.",
    )
    app.command()(run)
    app.command()(check)
    app.command(epilog=SCHEMA_EXAMPLES)(schema)
    app.command("list")(list_racks)
    app.command()(status)
    app.command()(stop)
    app.command()(clean)
    app.command(epilog=COMMANDING)(command)
    app.command(cls=KindsCommand, epilog=INJECTING)(inject)
    app.command()(estop)
    app.command()(record)
    app.command()(replay)
    app.command()(report)
    app.command()(analyze)
    app.command()(gantt)
    app.add_typer(bench, name="bench")
    app.command()(campaign)
    return app


def main() -> None:
    """Run the command line; what is refused shows as one line a mistake."""
    if sys.platform != "linux":
        sys.exit(f"rack runs on Linux alone, not on {sys.platform}: it needs /dev/shm, pidfds and SCHED_FIFO")
    # First of all: to import what commands need takes longer than many a command.
    INTERRUPT.catch()
    try:
        run_commands()
    except Interrupted:
        return
    finally:
        INTERRUPT.settle()


def run_commands() -> None:
    """Run the command line in this process, its signals left alone."""
    from rack.boards.errors import shown
    from rack.tools.answer import Failure, fail

    try:
        _look_over(sys.argv[1:])
        commands()(prog_name="rack")
    except Failure as failure:
        fail(str(failure), failure.status)
    except OSError as error:
        if error.filename is None:
            raise
        fail(f"{shown(str(error.filename))}: {error.strerror}", 2 if error.errno in USAGE else 1)
    except Exception as error:
        status_of_error = _status(error)
        if status_of_error is None:
            raise
        fail(str(error), status_of_error)


def _look_over(arguments: list[str]) -> None:
    """Refuse what no command can use, before any sees it. Raises `Failure`."""
    from rack.boards.errors import shown
    from rack.tools.answer import Failure

    for at, argument in enumerate(arguments, 1):
        if len(argument) > LONGEST_ARGUMENT:
            raise Failure(
                f"argument {at} = {shown(argument)}: {len(argument)} characters; at most {LONGEST_ARGUMENT}", 2
            )
        if any("\ud800" <= c <= "\udfff" for c in argument):
            raise Failure(f"argument {at} = {shown(argument)}: is no UTF-8", 2)


def _status(error: Exception) -> int | None:
    """Return the exit status of an error that the project raises on purpose; None for any other."""
    from rack.backplane.errors import BackplaneError
    from rack.boards.errors import BoardError, ConfigError
    from rack.levels.errors import LevelError

    if isinstance(error, ConfigError):
        return 2
    return 1 if isinstance(error, BackplaneError | BoardError | LevelError) else None


if __name__ == "__main__":
    main()
