"""`rack stop`: end a run."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from rack.backplane.process import is_alive, readable
from rack.backplane.segment import Segment
from rack.backplane.words import Head, System
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, RackName

Wait = Annotated[
    float, typer.Option(metavar="S", min=0.0, max=1e9, help="seconds to wait for the run's end")
]


def stop(rack: RackName, wait: Wait = 10.0, as_json: Json = False) -> None:
    """End a run and wait until it is gone.

    The run ends in order at its next tick, and writes its report.

    Exit status: 0 it has ended; 1 there is no such rack, or it is still running after --wait.

    \b
    Examples:
      rack stop nasrem
      rack stop nasrem --wait 30
    """
    if not stop_rack(rack, wait):
        raise Failure(
            f"rack '{rack}' has not ended within {wait:g} s; its launcher is still running"
        )
    print_answer({"rack": rack, "stopped": True}, f"rack '{rack}' has ended", as_json)


def stop_rack(rack: str, timeout_s: float) -> bool:
    """Request a rack's end and wait for its launcher to end; return False if it still runs after
    `timeout_s`.

    Raises `SegmentError` when there is no such rack.
    """
    segment = Segment.attach(rack)
    pid = segment.words[Head.LAUNCHER_PID]
    started = segment.words[Head.LAUNCHER_START]
    segment.words[System.STOP_REQUEST] = 1
    segment.close()
    if not is_alive(pid, started):
        return True
    try:
        launcher = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        # Another process may have taken the pid between the two calls.
        return not is_alive(pid, started) or readable(launcher, timeout_s)
    finally:
        os.close(launcher)
