"""A host board: one process under ordinary scheduling, which runs a program until that returns or
the rack ends it.
"""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from pathlib import Path
from types import FrameType

from rack.backplane.errors import MailboxError
from rack.backplane.process import adopt_orphans
from rack.backplane.segment import Segment
from rack.boards.classes import find_class
from rack.boards.errors import LONGEST_REASON, one_line
from rack.boards.host.bus import HostBus
from rack.boards.wiring import HostWiring
from rack.levels.host_program import HostProgram

RELEASED_S = 2.0
"""Longest wait for the end of what the board's process before this one has forked."""
LOOK_S = 0.01
FAILED = 1
"""Exit status of a host board whose program raised an exception."""


def run_host_board(segment: Segment, wiring: HostWiring, attention: int, output: int) -> int:
    """Run a host board's program, which prints to `output`; return the exit status of its process.

    The process leads a session of its own, and what its children leave behind becomes its own
    child, then the crate's, which ends it. `attention` is an eventfd on which the Rack waits.
    """
    os.setsid()
    adopt_orphans()
    os.dup2(output, 1)
    os.dup2(output, 2)
    # The crate ignores it. A program that is ended leaves its `with` and `finally` blocks, as at
    # sys.exit.
    signal.signal(signal.SIGTERM, _leave)
    bus = _opened(segment, wiring)
    os.eventfd_write(attention, 1)
    try:
        bus.await_turn()
        # Imported here, not in the crate: a program may import anything, and the crate must stay
        # single-threaded.
        program = find_class(wiring.target, HostProgram)(wiring.context)
        bus.connect(program)
        program.run(bus)
    except SystemExit as end:
        if end.code and not bus.is_over:
            return _failed(wiring.board, end)
    except Exception as error:
        return _failed(wiring.board, error)
    bus.finish()
    return 0


def _opened(segment: Segment, wiring: HostWiring) -> HostBus:
    """Open the bus. What the process before this one has forked is being killed, and may hold the
    board meanwhile.
    """
    deadline = time.monotonic() + RELEASED_S
    while True:
        try:
            return HostBus(segment, wiring)
        except MailboxError:
            if time.monotonic() > deadline:
                raise
            time.sleep(LOOK_S)


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(f"ended by {signal.Signals(number).name}")


def _failed(board: str, error: BaseException) -> int:
    """Print an exception as one line: it becomes an event of the run."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    text = one_line(f"{type(error).__name__}: {error}", LONGEST_REASON)
    # The crate passes on what boards print.
    print(f"host board '{board}': {text}{place}", file=sys.stderr, flush=True)
    return FAILED
