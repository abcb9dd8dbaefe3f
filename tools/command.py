"""`rack command`: tell a level of a running rack what to do, as its operator."""

from __future__ import annotations

from typing import Annotated

import typer

from tools.answer import Failure, Json, print_json
from tools.interrupt import INTERRUPT

Rack = Annotated[str, typer.Argument(metavar="RACK", help="running rack by name, as 'rack list' shows it")]
Level = Annotated[
    str | None, typer.Argument(metavar="LEVEL", help="task, elemental_move, primitive, servo, or your own")
]
Said = Annotated[str | None, typer.Argument(metavar="WHAT", help="hold, resume, setpoint or goto")]
Goals = Annotated[
    list[str] | None,
    typer.Argument(metavar="GOAL", help="home, or as in joints=0.2,1.3,... position=0.4,0.1,0.9 direction=0,0,-1"),
]
Tick = Annotated[int | None, typer.Option(metavar="T", help="tick at which it is given; default: the next one")]
At = Annotated[float | None, typer.Option(metavar="S", help="instead of --tick: simulated time, s")]
Wait = Annotated[bool, typer.Option("--wait", help="wait until it is done: the arm rests, or is at its goal")]
List = Annotated[bool, typer.Option("--list", help="list what each level of the rack can be told")]

EXAMPLES = """\b
Examples:

  rack command nasrem --list

  rack command nasrem task hold

  rack command nasrem task resume

  rack command nasrem servo setpoint joints=0.2,1.3,-2.9,0,-1.3,0 --wait

  rack command nasrem task goto position=0.45,0.1,0.95

  rack command nasrem task goto home --tick 4000
"""


def command(
    rack: Rack,
    level: Level = None,
    what: Said = None,
    goal: Goals = None,
    tick: Tick = None,
    at: At = None,
    wait: Wait = False,
    is_list: List = False,
    as_json: Json = False,
) -> None:
    """Tell a level of a running rack what to do, beside or instead of the level above it.

    hold: the arm comes to rest on its way, and stays. setpoint (of the servo level) and goto: it moves to a goal, and
    stays. resume: the level goes on with its own work. What was said stands until resume, through restarts of the
    level's board too; an emergency stop comes before it.

    A setpoint is followed straight in joint space: nobody looks for what is in the way.

    Exit status: 0 the level took it up (with --wait: it is done), 1 it refused, or gave no answer in time, 2 usage.
    """
    from tools.commanding.goals import goal_of
    from tools.commanding.live import LiveDesk

    desk = LiveDesk(rack)
    if is_list:
        print_json(desk.levels()) if as_json else print("\n".join(desk.text()))
        return
    if level is None or what is None:
        raise Failure(f"LEVEL and WHAT are needed, as in: rack command {rack} task hold; or --list", 2)
    # Raised, not ended at once: a command that nobody waits for any more is withdrawn.
    with INTERRUPT.raising():
        told = desk.give({"level": level, "what": what, "tick": tick, "at": at, **goal_of(goal or [])}, wait)
    print_json(told.document()) if as_json else print(told.line)
    if not told.worked:
        raise typer.Exit(1)
