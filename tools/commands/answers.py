"""Answers of `rack list` and `rack status`, apart from their options: parsing those takes
longer."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import asdict

from rack.tools.console.answer import Failure, print_answer, print_json


def list_racks(as_json: bool) -> None:
    """Print the racks on this machine."""
    from rack.backplane.segment import racks
    from rack.tools.console.tables import fitted

    found = [describe(name) for name in racks()]
    rows = [[str(rack[key]) for key in ("rack", "state", "detail")] for rack in found]
    if rows:
        print_answer(found, fitted(("rack", "state", ""), rows), as_json)
    else:
        print_answer(found, "no racks", as_json)


def describe(name: str) -> dict[str, str | int | float | None]:
    """Return the name, as "rack", the state and details of a rack; its age is in seconds. The
    launcher's process id is None in another PID namespace."""
    from rack.backplane.checked import as_named
    from rack.backplane.errors import SegmentError
    from rack.backplane.segment import Segment
    from rack.backplane.words import Head, Run, System

    try:
        segment = Segment.attach(name)
        state = as_named(Run, segment.words[System.STATE]).name.lower()
    except SegmentError as error:
        return {"rack": name, "state": "foreign", "detail": str(error)}
    words = segment.words
    age_s = time.time() - words[Head.CREATED_NS] * 1e-9
    alive = segment.launcher_is_alive
    if not alive:
        state = "dead"
    gone = "its launcher is gone: 'rack clean' removes it"
    by = f"launched {age_s:.0f} s ago by {segment.launcher_text}" if alive else gone
    boards = len({task.board for task in segment.layout.tasks})
    hosts = len(segment.layout.hosts)
    side = f" and {hosts} on the host side" if hosts else ""
    detail = f"{boards} boards{side}, tick {words[System.TICK]}, {by}"
    launcher = segment.launcher or None
    segment.close()
    return {
        "rack": name,
        "state": state,
        "detail": detail,
        "launcher": launcher,
        "age_s": round(age_s, 3),
    }


def show_status(rack: str | None, as_json: bool) -> None:
    """Print a running rack as it is now. Raises `Failure` if none is named and there is not exactly
    one."""
    from rack.backplane.segment import Segment
    from rack.tools.live.snapshot import RackMonitor
    from rack.tools.recording.recorder_process import recorded_by, recorded_line, size_of

    with closing(Segment.attach(rack or only_rack())) as segment:
        found = RackMonitor(segment).look()
        run = recorded_by(segment)
    if as_json:
        recording = None if run is None else {"folder": str(run), "bytes": size_of(run)}
        print_json({**asdict(found), "recording": recording})
        return
    from rack.tools.console.tables import console
    from rack.tools.live.display import RackView

    console().print(RackView(found))
    if run is not None:
        print(recorded_line(run, found.time_s))


def only_rack() -> str:
    """Return the only rack on this machine. Raises `Failure` if there is not exactly one."""
    from rack.backplane.segment import racks

    running = racks()
    if not running:
        raise Failure("no rack is running")
    if len(running) > 1:
        raise Failure(f"RACK is missing; racks: {', '.join(running)}", 2)
    return running[0]
