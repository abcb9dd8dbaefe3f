"""One line about each rack on the machine."""

from __future__ import annotations

import time

from rack.backplane.errors import SegmentError
from rack.backplane.segment import Segment
from rack.backplane.words import Head, Run, System


def describe(name: str) -> dict[str, str | int | float]:
    """Return name, as "rack", state and detail of a rack; state "dead" when its launcher is gone."""
    try:
        segment = Segment.attach(name)
    except SegmentError as error:
        return {"rack": name, "state": "foreign", "detail": str(error)}
    words = segment.words
    age_s = time.time() - words[Head.CREATED_NS] * 1e-9
    launcher = words[Head.LAUNCHER_PID]
    alive = segment.launcher_is_alive
    state = Run(words[System.STATE]).name.lower() if alive else "dead"
    by = (
        f"launched {age_s:.0f} s ago by process {launcher}"
        if alive
        else "its launcher is gone: 'rack clean' removes it"
    )
    boards = len({task.board for task in segment.layout.tasks})
    detail = f"{boards} boards, tick {words[System.TICK]}, {by}"
    segment.close()
    return {"rack": name, "state": state, "detail": detail, "launcher": launcher, "age_s": round(age_s, 3)}
