"""`rack stop`: end a run."""

from __future__ import annotations

from typing import Annotated

import typer

from rack.tools.answer import Failure, Json, RackName, print_json


def stop(
    rack: RackName,
    wait: Annotated[
        float, typer.Option(metavar="S", min=0.0, max=1e9, help="seconds to wait for the rack's end")
    ] = 10.0,
    as_json: Json = False,
) -> None:
    """End a run and wait until it is gone.

    The run ends in order at its next tick, and its report is made.

    Exit status: 0 it has ended, 1 there is no such rack or it still runs after --wait.

    \b
    Examples:
      rack stop nasrem --wait 30
    """
    from rack.tools.stopping import stop_rack

    if not stop_rack(rack, wait):
        raise Failure(f"rack '{rack}' has not ended within {wait:g} s; its launcher still runs")
    print_json({"rack": rack, "stopped": True}) if as_json else print(f"rack '{rack}' has ended")
