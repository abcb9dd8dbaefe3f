"""The recorder's process, `python -m tools.recorder`: stdin names rack and folder, and ends when the run is over."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

from backplane.segment import Segment
from tools.recorder.recorder import Recorder


def main() -> None:
    """Attach to the rack that one line of JSON names, say so on stdout, record until stdin ends."""
    # Ctrl-C reaches the whole foreground group; the launcher decides when the recording is complete.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    line = sys.stdin.readline()
    if not line:
        return
    rack, folder = json.loads(line)
    with Recorder(Segment.attach(rack), Path(folder)) as recorder:
        print("recording", flush=True)
        recorder.follow(until=sys.stdin.fileno())


if __name__ == "__main__":
    main()
