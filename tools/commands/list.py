"""`rack list`: list the racks on this machine."""

from __future__ import annotations

import time
from contextlib import closing

from rack.backplane.checked import to_enum
from rack.backplane.errors import SegmentError
from rack.backplane.segment import Segment
from rack.backplane.segment import list_racks as list_rack_names
from rack.backplane.words import Head, Run, System
from rack.tools.console.answer import Document, print_answer
from rack.tools.console.parameters import Json
from rack.tools.console.tables import format_fitted_table


def list_racks(as_json: Json = False) -> None:
    """List the racks on this machine, running or left behind by a killed launcher.

    The states are starting, running and stopped. A rack is dead if its launcher has ended, and
    foreign if its shared memory belongs to another version or user. `rack clean` removes dead
    racks.

    To list the racks on another machine: ssh HOST rack list.

    \b
    Examples:
      rack list
      rack list --json
    """
    descriptions = [describe_rack(name) for name in list_rack_names()]
    rows = [[rack["rack"], rack["state"], rack["detail"]] for rack in descriptions]
    text = format_fitted_table(("rack", "state", ""), rows) if rows else "no racks"
    print_answer(descriptions, text, as_json)


def describe_rack(name: str) -> Document:
    """Return a document with the name, state and details of one rack.

    `age_s` is the time since its launch. `launcher` is the process id of its launcher, or None if
    the launcher is in another PID namespace. The document of a foreign rack has neither.
    """
    try:
        segment = Segment.attach(name)
    except SegmentError as error:
        return {"rack": name, "state": "foreign", "detail": str(error)}
    with closing(segment):
        words = segment.words
        age_s = time.time() - words[Head.CREATED_NS] * 1e-9
        state = "dead"
        launcher_text = "its launcher is gone: 'rack clean' removes it"
        if segment.launcher_is_alive:
            state = to_enum(Run, words[System.STATE]).name.lower()
            launcher_text = f"launched {age_s:.0f} s ago by {segment.launcher_text}"
        boards = len({task.board for task in segment.layout.tasks})
        hosts = len(segment.layout.hosts)
        host_text = f" and {hosts} on the host side" if hosts else ""
        return {
            "rack": name,
            "state": state,
            "detail": f"{boards} boards{host_text}, tick {words[System.TICK]}, {launcher_text}",
            "launcher": segment.launcher or None,
            "age_s": round(age_s, 3),
        }
