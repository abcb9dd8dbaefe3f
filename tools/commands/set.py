"""`rack set`: set a live parameter of a running rack."""

from __future__ import annotations

from contextlib import closing

from rack.backplane.segment import Segment
from rack.tools.commands.command import At, Tick, print_reply
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, argument
from rack.tools.monitor.desk import LiveDesk


def set_param(
    rack: RackName,
    setting: str = argument("KEY=VALUE", "as in board.servo.params.bandwidth=80"),
    tick: Tick = None,
    at: At = None,
    as_json: Json = False,
) -> None:
    r"""Set a live parameter of a running rack, between two cycles of its level.

    'rack schema' marks those that a level declares as live; all others are read at the launch
    alone. This is an operator's command: the level sets it again when its board is restarted, and a
    run in lockstep repeats with the same command, what = "set", in its config.

    Exit status: 0 the parameter is set; 1 the level refused it, or did not answer in time; 2 it is
    not live, or the value is not valid.

    \b
    Examples:
      rack set nasrem board.servo.params.bandwidth=80
      rack set nasrem board.servo.params.damping=0.8 --at 12.5
    """
    with INTERRUPT.raising(), closing(Segment.attach(rack)) as segment:
        reply = LiveDesk(segment).set_param(setting, tick, at)
    print_reply(reply, as_json)
