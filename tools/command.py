"""`rack command`: command one level of a running rack, as its operator."""

from __future__ import annotations

from typing import Annotated

import typer

from rack.tools.answer import Failure, Json, RackName, print_json
from rack.tools.interrupt import INTERRUPT

Level = Annotated[
    str | None, typer.Argument(metavar="LEVEL", help="task, elemental_move, primitive, servo, or your own")
]
Said = Annotated[str | None, typer.Argument(metavar="WHAT", help="hold, resume, setpoint or goto")]
Goals = Annotated[
    list[str] | None,
    typer.Argument(metavar="GOAL", help="home, or as in joints=0.2,1.3,... position=0.4,0.1,0.9 direction=0,0,-1"),
]
Tick = Annotated[int | None, typer.Option(metavar="T", help="tick at which it is given; default: the next one")]
At = Annotated[float | None, typer.Option(metavar="S", min=0.0, max=1e9, help="instead of --tick: simulated time, s")]
Wait = Annotated[bool, typer.Option("--wait", help="wait until it is done: the arm is at rest, or at its goal")]
Timeout = Annotated[
    float | None,
    typer.Option(metavar="S", min=0.0, max=1e9, help="with --wait: wall-clock seconds, then exit status 1"),
]
List = Annotated[bool, typer.Option("--list", help="list each level, the commands that it takes, and what is in force")]

EXAMPLES = """\b
Examples:

  rack command nasrem --list

  rack command nasrem task hold

  rack command nasrem task resume

  rack command nasrem servo setpoint joints=0.2,1.3,-2.9,0,-1.3,0 --wait

  rack command nasrem task goto position=0.45,0.1,0.95

  rack command nasrem task goto home --tick 4000 --wait --timeout 60
"""


def command(
    rack: RackName,
    level: Level = None,
    what: Said = None,
    goal: Goals = None,
    tick: Tick = None,
    at: At = None,
    wait: Wait = False,
    timeout: Timeout = None,
    is_list: List = False,
    as_json: Json = False,
) -> None:
    """Command one level of a running rack, overriding the level above it.

    hold: the arm comes to rest on its path and stays there. setpoint (servo level) and goto: it moves to a goal and
    stays there. resume: the level goes on with its own work. A command stays in force until resume, even if the
    level's board restarts. An emergency stop takes precedence.

    A setpoint is followed on a straight line in joint space, without checking for collisions.

    Exit status: 0 the level took the command up, with --wait: it is done; 1 it refused, or did not answer in time; 2
    usage.
    """
    from rack.tools.commanding.goals import goal_of
    from rack.tools.commanding.live import LiveDesk
    from rack.tools.holds import resume_command
    from rack.tools.live_table import terminal_width

    desk = LiveDesk(rack)
    if is_list:
        print_json(desk.levels()) if as_json else print("\n".join(desk.text(terminal_width())))
        return
    if level is None or what is None:
        raise Failure(f"LEVEL and WHAT are needed, as in: rack command {rack} task hold; or --list", 2)
    if timeout is not None and not wait:
        raise Failure("--timeout is the bound of --wait; give both, or neither", 2)
    # Raised, not ended at once: a command that nobody waits for any more is withdrawn.
    with INTERRUPT.raising():
        told = desk.give({"level": level, "what": what, "tick": tick, "at": at, **goal_of(goal or [])}, wait, timeout)
    print_json(told.document()) if as_json else print(told.line)
    if not told.worked:
        raise typer.Exit(1)
    if told.is_standing and what != "resume" and not as_json:
        print(f"in force until: {resume_command(rack, level)}")
