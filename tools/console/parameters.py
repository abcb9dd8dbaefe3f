"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rack.tools.console.answer import Failure


def option(declared: str, meaning: str, default: Any = None, **more: Any) -> Any:
    """Declare an option of a command, as the default value of a parameter of its function.

    Args:
        declared: Name of the option, and of its value if it takes one, as in "--seconds S".
        meaning: Help text.
        default: Value if the option is absent. `...` if it is required.
        more: Further arguments of `typer.Option`, such as `min` and `max`.
    """
    name, _, metavar = declared.partition(" ")
    return typer.Option(default, name, metavar=metavar or None, help=meaning, **more)


def argument(name: str, meaning: str, default: Any = ..., **more: Any) -> Any:
    """Declare an argument of a command, as the default value of a parameter of its function.

    Args:
        name: Name in the help text.
        meaning: Help text.
        default: Value if the argument is absent. `...` if it is required.
        more: Further arguments of `typer.Argument`.
    """
    return typer.Argument(default, metavar=name, help=meaning, **more)


def complete_config_name(start: str) -> list[str]:
    """List the shipped configs whose names begin with `start`, for shell completion."""
    from rack.boards.config import list_names

    return [name for name in list_names() if name.startswith(start)]


def complete_rack_name(start: str) -> list[str]:
    """List the racks in shared memory whose names begin with `start`, for shell completion."""
    from rack.backplane.segment import list_racks

    return [name for name in list_racks() if name.startswith(start)]


def check_timeout(timeout: float | None, wait: bool) -> None:
    """Raise `Failure` if --timeout is given without --wait."""
    if timeout is not None and not wait:
        raise Failure("--timeout needs --wait; give both, or neither", 2)


def check_rack_name(rack: str | None) -> str | None:
    """Return the name of a rack unchanged. Raises `Failure` if it is empty."""
    if rack == "":
        raise Failure('RACK = "": must be the name of a running rack, as "rack list" shows it', 2)
    return rack


def check_local_rack_name(rack: str | None) -> str | None:
    """Return the name of a rack unchanged.

    Raises `Failure` if it is empty or names a rack on another machine.
    """
    if rack is not None and "/" in rack:
        raise Failure(
            f"RACK = {rack}: run this command on the rack's machine, as in: ssh HOST rack status;"
            " only 'rack estop' works from another machine",
            2,
        )
    return check_rack_name(rack)


Json = Annotated[
    bool, typer.Option("--json", help="print one JSON document on stdout, and nothing else")
]
Full = Annotated[bool, typer.Option("--full", help="print the whole report, with all tables")]
ConfigName = Annotated[
    str,
    typer.Argument(
        metavar="CONFIG",
        help="config by name, or path to a .toml file",
        autocompletion=complete_config_name,
    ),
]
RackName = Annotated[
    str,
    typer.Argument(
        metavar="RACK",
        help="running rack by name, as 'rack list' shows it",
        autocompletion=complete_rack_name,
        callback=check_local_rack_name,
    ),
]
RunFolder = Annotated[
    Path, typer.Argument(metavar="RUN", help="folder of a run, as in runs/nasrem-20250101-120000")
]
Anyway = Annotated[
    bool,
    typer.Option(
        "--anyway",
        help="repeat a run although its code or files have changed since; digests may differ",
    ),
]
View = Annotated[bool, typer.Option("--view", help="open the viewer on the running rack")]
Timeout = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=0.0,
        max=1e9,
        help="with --wait: give up after S seconds of wall-clock time",
    ),
]
Settings = Annotated[
    list[str],
    typer.Option(
        "--set", metavar="KEY=VALUE", help="override one value, as in clock.speed=2; repeatable"
    ),
]
Faults = Annotated[
    str | None,
    typer.Option(
        metavar="FILE", help="fault script, by name or path; added to the config's own faults"
    ),
]
