"""The `rack` command: one file a subcommand; each imports what it needs only when it runs."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from tools.interrupt import INTERRUPT, Interrupted

if TYPE_CHECKING:
    import typer


def commands() -> typer.Typer:
    """Return the command line."""
    import typer

    from tools.analyze import analyze
    from tools.bench.command import bench
    from tools.campaign.command import campaign
    from tools.check import check
    from tools.clean import clean
    from tools.command import EXAMPLES, command
    from tools.estop import estop
    from tools.gantt import gantt
    from tools.inject import inject
    from tools.injecting.kinds import KindsCommand
    from tools.list import list_racks
    from tools.record import record
    from tools.replay import replay
    from tools.report import report
    from tools.run import run
    from tools.status import status
    from tools.stop import stop

    app = typer.Typer(
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        help="Run, watch and command racks: crates of boards, one process each, under a common clock.",
        epilog="Exit status: 0 it worked, 1 it did not, 2 usage or config error, 128 + N ended by signal N.",
    )
    app.command()(run)
    app.command()(check)
    app.command("list")(list_racks)
    app.command()(status)
    app.command()(stop)
    app.command()(clean)
    app.command(epilog=EXAMPLES)(command)
    app.command(cls=KindsCommand)(inject)
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
        _run()
    except Interrupted:
        return
    finally:
        INTERRUPT.settle()


def _run() -> None:
    from tools.answer import Failure, fail

    try:
        commands()(prog_name="rack")
    except Failure as failure:
        fail(str(failure), failure.status)
    except OSError as error:
        if error.filename is None:
            raise
        fail(f"{error.filename}: {error.strerror}", 1)
    except Exception as error:
        status_of_error = _status(error)
        if status_of_error is None:
            raise
        fail(str(error), status_of_error)


def _status(error: Exception) -> int | None:
    """Return the exit status of an error that the project raises on purpose; None for any other."""
    from backplane.errors import BackplaneError
    from boards.errors import BoardError, ConfigError
    from levels.errors import LevelError

    if isinstance(error, ConfigError):
        return 2
    return 1 if isinstance(error, BackplaneError | BoardError | LevelError) else None


if __name__ == "__main__":
    main()
