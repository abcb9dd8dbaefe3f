"""A host board: a process that runs a program under ordinary scheduling.

It ends when the program returns or the rack ends it.
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
from rack.backplane.process import adopt_orphans, write_line
from rack.backplane.segment import Segment
from rack.boards.errors import MAX_REASON_LENGTH, to_one_line
from rack.boards.host.bus import HostBus
from rack.boards.wiring import HostWiring
from rack.levels.errors import RunOver
from rack.levels.host_program import HostProgram
from rack.levels.references import find_class

CLAIM_S = 2.0
"""Longest wait for the end of processes that the previous process of this board has forked."""
RETRY_S = 0.01
"""Time between two attempts to open the bus."""
FAILED_STATUS = 1
"""Exit status of a host board whose program raised an exception."""


def run_host_board(segment: Segment, wiring: HostWiring, attention: int, output: int) -> int:
    """Run the program of a host board in this process, which becomes the leader of a session.

    The process becomes the parent of its orphaned descendants. When it ends, the crate becomes
    their parent and kills them.

    Args:
        segment: Segment of the rack.
        wiring: Wiring of the host board.
        attention: Descriptor of the eventfd on which the Rack waits.
        output: Descriptor to which the program prints.

    Returns:
        The exit status of the process.
    """
    os.setsid()
    adopt_orphans()
    os.dup2(output, 1)
    os.dup2(output, 2)
    # The crate ignores this signal, and its children inherit that. Handle it in this process, so
    # that the program's `with` and `finally` blocks are executed.
    signal.signal(signal.SIGTERM, _exit_on_signal)
    bus = _open_bus(segment, wiring)
    os.eventfd_write(attention, 1)
    try:
        bus.await_turn()
        # Import the program only in this process: it may start threads, and the crate must stay
        # single-threaded.
        program = find_class(wiring.target, HostProgram)(wiring.context)
        bus.connect_ports(program)
        program.run(bus)
    except RunOver:
        # The end of the run has interrupted the program, which is no failure of either.
        pass
    except SystemExit as end:
        if end.code and not bus.is_over:
            return _report_failure(wiring.board, end)
    except Exception as error:
        return _report_failure(wiring.board, error)
    bus.finish()
    return 0


def _open_bus(segment: Segment, wiring: HostWiring) -> HostBus:
    """Open the bus. If it is still claimed, try again for `CLAIM_S`.

    After a restart, processes that the program forked may keep the claim until the crate has killed
    them.
    """
    deadline = time.monotonic() + CLAIM_S
    while True:
        try:
            return HostBus(segment, wiring)
        except MailboxError:
            if time.monotonic() > deadline:
                raise
            time.sleep(RETRY_S)


def _exit_on_signal(number: int, frame: FrameType | None) -> None:
    """Handle a signal by raising `SystemExit`."""
    raise SystemExit(f"ended by {signal.Signals(number).name}")


def _report_failure(board: str, error: BaseException) -> int:
    """Print an exception as one line, which becomes an event, and return the exit status."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    text = to_one_line(f"{type(error).__name__}: {error}", MAX_REASON_LENGTH)
    # The crate passes the output of host boards on to the Rack.
    write_line(sys.stderr, f"host board '{board}': {text}{place}")
    return FAILED_STATUS
