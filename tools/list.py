"""`rack list`: the racks on this machine."""

from __future__ import annotations

import time

from rack.backplane.errors import SegmentError
from rack.backplane.segment import Segment, racks
from rack.backplane.words import Head, Run, System
from rack.tools.console.answer import Json, print_answer
from rack.tools.console.tables import table, terminal_width


def list_racks(as_json: Json = False) -> None:
    """List the racks on this machine, running or left behind by a killed launcher.

    The states are starting, running and stopped; dead, if the launcher is gone; and foreign, if the shared memory is of
    another version or user. `rack clean` removes dead racks.

    \b
    Examples:
      rack list
      rack list --json
    """
    found = [describe(name) for name in racks()]
    rows = [[str(rack[key]) for key in ("rack", "state", "detail")] for rack in found]
    print_answer(found, table(("rack", "state", ""), rows, terminal_width()) if rows else "no racks", as_json)


def describe(name: str) -> dict[str, str | int | float]:
    """Return the name, as "rack", the state and details of a rack; its age is in seconds."""
    try:
        segment = Segment.attach(name)
    except SegmentError as error:
        return {"rack": name, "state": "foreign", "detail": str(error)}
    words = segment.words
    age_s = time.time() - words[Head.CREATED_NS] * 1e-9
    launcher = words[Head.LAUNCHER_PID]
    alive = segment.launcher_is_alive
    state = Run(words[System.STATE]).name.lower() if alive else "dead"
    gone = "its launcher is gone: 'rack clean' removes it"
    by = f"launched {age_s:.0f} s ago by process {launcher}" if alive else gone
    boards = len({task.board for task in segment.layout.tasks})
    detail = f"{boards} boards, tick {words[System.TICK]}, {by}"
    segment.close()
    return {"rack": name, "state": state, "detail": detail, "launcher": launcher, "age_s": round(age_s, 3)}
