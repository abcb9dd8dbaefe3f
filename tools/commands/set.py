"""`rack set`: set a live parameter of a running rack."""

from __future__ import annotations

from contextlib import closing

from rack.backplane.segment import Segment
from rack.tools.commands.command import At, Tick, print_reply
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, argument
from rack.tools.monitor.desk import LevelCommander


def set_param(
    rack: RackName,
    setting: str = argument("KEY=VALUE", "as in board.servo.params.bandwidth=80"),
    tick: Tick = None,
    at: At = None,
    as_json: Json = False,
) -> None:
    """Set a live parameter of a running rack, between two cycles of its level.

    'rack schema' marks the parameters that a level declares as live. All others take effect only at
    launch. The setting is an operator's command: it is given again when the board of the level is
    restarted. To repeat the run in lockstep, put the same command, what = "set", into the config.

    Exit status: 0 the parameter is set; 1 the level refused it, or did not answer in time; 2 the
    parameter is not live, or the value is invalid.

    \b
    Examples:
      rack set nasrem board.servo.params.bandwidth=80
      rack set nasrem board.servo.params.damping=0.8 --at 12.5
    """
    with INTERRUPT.raise_interrupted(), closing(Segment.attach(rack)) as segment:
        reply = LevelCommander(segment).set_param(setting, tick, at)
    print_reply(reply, as_json)
