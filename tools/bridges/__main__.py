"""The process of a bridge, `python -m rack.tools.bridges NAME`, for `rack run`.

The line on stdin names the rack. Every line that it prints is a message to the user.
"""

from __future__ import annotations

import os
import signal
import sys

from rack.tools.recording.recorder.__main__ import NICENESS


def main() -> int:
    """Run the bridge until the run is over. Returns the exit status."""
    # Ctrl-C reaches the whole foreground group, but the launcher decides when the bridge ends.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICENESS)
    from rack.backplane.segment import Segment
    from rack.tools.bridges.bridge import run_bridge
    from rack.tools.console.answer import Failure

    def tell(text: str) -> None:
        print(" ".join(text.split()), flush=True)

    if not (rack := sys.stdin.readline().strip()):
        return 0
    try:
        run_bridge(sys.argv[1], Segment.attach(rack), tell)
    except Exception as error:
        is_expected = isinstance(error, Failure)
        tell(str(error) if is_expected else f"{type(error).__name__}: {error}")
        return 1
    return 0


if __name__ == "__main__":
    # Threads of the libraries must not delay the end of the process.
    os._exit(main())
