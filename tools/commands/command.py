"""`rack command` and `rack set`: command one level of a running rack, as its operator."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RackName, Timeout, argument, check_timeout, option

if TYPE_CHECKING:
    from rack.tools.monitor.replies import Reply

Tick = Annotated[
    int | None, typer.Option(metavar="T", help="tick of the command; default: the next one")
]
At = Annotated[
    float | None, typer.Option(metavar="S", min=0.0, max=1e9, help="the same in simulated seconds")
]


def command(
    rack: RackName,
    level: str | None = argument(
        "LEVEL", "task, elemental_move, primitive, servo, or your own level", None
    ),
    what: str | None = argument(
        "WHAT", "hold, resume, setpoint, goto, enable, ...; see above", None
    ),
    goal: list[str] | None = argument(
        "GOAL",
        "home, or as in joints=0.2,1.3,... position=0.4,0.1,0.9 direction=0,0,-1; for"
        " modify: NAME on|off; for table, schedule: NAME; for do: the level's command; for set:"
        " KEY=VALUE",
        None,
    ),
    tick: Tick = None,
    at: At = None,
    wait: bool = option(
        "--wait", "wait until the command is done: the arm is at rest, or at its goal", False
    ),
    timeout: Timeout = None,
    lease: bool = option(
        "--lease",
        "stay while the command is in force; if this program ends first, the level holds",
        False,
    ),
    is_list: bool = option(
        "--list", "list the levels, the commands that each takes, and its command in force", False
    ),
    as_json: Json = False,
) -> None:
    """Command one level of a running rack, overriding the level above it.

    \b
    hold      bring the arm to rest on its path, and keep it there
    goto      move the arm to a goal, and keep it there
    setpoint  the same, at the servo level: a straight line in joint space,
              without checking for collisions
    resume    return the level to automatic mode
    modify    switch a control modification of the servo level on or off,
              between two samples and without a step in the torque
    table     switch to another state table
    do        give the level one of its own commands, in place of the level above
    set       set a live parameter of the level, as 'rack set' does
    schedule  change the scheduler of the level's board, if the config names one
    enable    ask the arm's drives for torque; the arm continues from its position
    disable   brake the arm, and take the torque from its drives
    reset     clear a fault of the arm's drives, which are then disabled
    release   end the bring-up of an arm, and permit full speed

    `hold`, `setpoint`, `goto` and `do` stay in force until `resume`. While one is in force, the
    mode of the level in 'rack status' is "operator" instead of "automatic". They survive a restart
    of the level's board. With --lease they stay in force as long as this program runs: Ctrl-C, a
    closed terminal or SIGKILL make the level hold. --wait only watches: if it is interrupted, the
    command stays in force. An emergency stop takes precedence. On a rack that is held between two
    ticks, this program returns at once and the command takes effect at the next step.

    Exit status: 0 the level accepted the command, or with --wait completed it; 1 it refused or did
    not answer in time; 2 usage.

    \b
    Examples:
      rack command nasrem --list
      rack command nasrem task hold
      rack command nasrem task resume
      rack command nasrem servo setpoint joints=0.2,1.3,-2.9,0,-1.3,0 --wait
      rack command nasrem task goto position=0.45,0.1,0.95
      rack command nasrem task goto home --tick 4000 --wait --timeout 60
      rack command nasrem task goto home --lease
      rack command hardware servo enable --wait
      rack command brown modifications modify wrist.deadzone on --at 2.5
      rack command nist-state-table task table careful
      rack command chimera trajectory schedule earliest-deadline-first
      rack command nist-state-table elemental_move do pick block1 --wait
    """
    from rack.backplane.segment import Segment
    from rack.levels.operator import EFFECTS, Operation
    from rack.tools.monitor.desk import LevelCommander, parse_goal
    from rack.tools.monitor.holds import format_resume_command

    check_timeout(timeout, wait)
    if lease and wait:
        raise Failure("--lease and --wait: a lease waits anyway; leave out --wait", 2)
    # Raise an exception on a signal, so that a command that has not been given yet is withdrawn.
    with INTERRUPT.raise_interrupted(), closing(Segment.attach(rack)) as segment:
        desk = LevelCommander(segment)
        if is_list:
            print_answer(desk.list_levels(), desk.format_levels(), as_json)
            return
        if level is None or what is None:
            raise Failure(
                f"LEVEL and WHAT are needed, as in: rack command {rack} task hold; or --list", 2
            )
        request = {
            "level": level,
            "what": what,
            "tick": tick,
            "at": at,
            **parse_goal(what, goal or []),
        }
        if lease:
            desk.lease_command(request, partial(print_reply, as_json=as_json))
            return
        reply = desk.give_command(request, wait, timeout)
    print_reply(reply, as_json)
    if reply.is_in_force and Operation[what.upper()] in EFFECTS and not as_json:
        print(f"in force until: {format_resume_command(rack, level)}")


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
    from rack.backplane.segment import Segment
    from rack.tools.monitor.desk import LevelCommander

    with INTERRUPT.raise_interrupted(), closing(Segment.attach(rack)) as segment:
        reply = LevelCommander(segment).set_param(setting, tick, at)
    print_reply(reply, as_json)


def print_reply(reply: Reply, as_json: bool) -> None:
    """Print the reply of a level, and flush stdout. Exit with status 1 if the level refused."""
    print_answer(asdict(reply) | {"worked": reply.worked}, reply.line, as_json)
    sys.stdout.flush()
    if not reply.worked:
        raise typer.Exit(1)
