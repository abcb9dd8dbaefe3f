"""The launcher's side of a bridge: start, messages for the user, end. The rack never needs it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial

from rack.backplane.process import describe_end, die_with_parent, wait_readable

ATTACH_S = 20.0
"""Longest time for which a launch waits until a bridge is connected."""
END_S = 1.0
"""Longest time for which the end of a run waits for the end of a bridge."""


def start_bridge(name: str, rack: str, stack: ExitStack) -> Callable[[], list[str]]:
    """Start `rack bridge`, and wait until it has reported its first line or has ended.

    Args:
        name: Name of the bridge.
        rack: A rack that is about to run. The end of its run ends the bridge.
        stack: Context at whose end the process ends at the latest.

    Returns:
        A function that returns new messages for the user.
    """
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "rack.tools.cli", "bridge", rack, name],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        # Ctrl-C reaches the whole foreground group, but the end of the run must end the bridge.
        process_group=0,
        preexec_fn=partial(die_with_parent, os.getpid()),
    )
    assert process.stderr is not None, "it is a pipe"
    stack.enter_context(process.stderr)
    stack.callback(_end_process, process)
    output = process.stderr.fileno()
    wait_readable(output, ATTACH_S)
    unread = b""

    def read_notices() -> list[str]:
        """Return new lines, and one about the end of a process that a signal has ended."""
        nonlocal unread
        while process.returncode is None and wait_readable(output, 0.0):
            if not (read := os.read(output, 1 << 16)) and (status := process.wait()) < 0:
                end = describe_end(status)
                read = f"ended ({end}); the rack goes on: rack bridge {rack} {name}\n".encode()
            unread += read
        *lines, unread = unread.split(b"\n")
        return [f"{name}: {line.decode(errors='replace')}" for line in lines]

    return read_notices


def _end_process(process: subprocess.Popen[bytes]) -> None:
    """Wait for the end of the process, or kill it."""
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
