"""The recorder's process, `python -m tools.recorder FOLDER`: told on stdin which rack, and by its end when to finish."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

from backplane.segment import Segment
from tools.recorder.recorder import Recorder


def main() -> None:
    """Attach to the rack that stdin names, say so on stdout, record until stdin ends."""
    # Ctrl-C reaches the whole foreground group; the launcher decides when the recording is complete.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    rack = sys.stdin.readline().strip()
    if not rack:
        return
    with Recorder(Segment.attach(rack), Path(sys.argv[1])) as recorder:
        print("recording", flush=True)
        recorder.follow(until=sys.stdin.fileno())


if __name__ == "__main__":
    main()
