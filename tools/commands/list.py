"""`rack list`: the racks on this machine."""

from __future__ import annotations

from rack.tools.commands import answers
from rack.tools.console.parameters import Json


def list_racks(as_json: Json = False) -> None:
    """List the racks on this machine, running or left behind by a killed launcher.

    The states are starting, running and stopped; dead, if the launcher is gone; and foreign, if the
    shared memory is of another version or user. `rack clean` removes dead racks.

    On another machine: ssh HOST rack list.

    \b
    Examples:
      rack list
      rack list --json
    """
    answers.list_racks(as_json)
