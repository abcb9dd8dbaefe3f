"""`rack stop`: end a run."""

from __future__ import annotations

import os
from contextlib import ExitStack, closing, suppress

from rack.backplane.process import wait_readable
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, RackName, option


def stop(
    rack: RackName,
    wait: float = option("--wait S", "seconds to wait for the run's end", 10.0, min=0.0, max=1e9),
    as_json: Json = False,
) -> None:
    """End a run, and wait until its launcher has ended.

    The run ends cleanly at its next tick, and writes its report.

    Exit status: 0 the run has ended; 1 there is no such rack, or it is still running after --wait.

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
    """Request the end of a rack and wait until its launcher has ended.

    For a rack in another PID namespace, wait until the launcher has closed it.

    Args:
        rack: Name of the rack.
        timeout_s: Maximum time to wait.

    Returns:
        False if the launcher still runs after `timeout_s`.

    Raises:
        SegmentError: There is no such rack.
    """
    with ExitStack() as stack:
        segment = stack.enter_context(closing(Segment.attach(rack)))
        launcher = -1
        with suppress(ProcessLookupError):
            if segment.launcher:
                launcher = os.pidfd_open(segment.launcher)
                stack.callback(os.close, launcher)
        # Check after opening the pidfd, because the pid of a dead launcher may have been reused. A
        # launcher that has closed the rack is still alive while it writes the report.
        is_own = launcher >= 0 and segment.launcher_is_alive
        segment.words[System.STOP_REQUEST] = 1
        return wait_readable(launcher, timeout_s) if is_own else segment.await_launcher(timeout_s)
