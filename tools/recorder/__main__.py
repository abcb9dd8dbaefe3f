"""The recorder process, `python -m rack.tools.recorder`: stdin names rack and folder, and closes when the run is over.

It prints "recording" once it has attached; every other line is a message for the user.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rack.backplane.segment import Segment
    from rack.tools.recorder.recorder import Sink

NICENESS = 10
"""On a shared core, boards go first, even those without real-time priority."""


def main() -> None:
    """Attach to the rack that one line of JSON names, and record until stdin closes."""
    # Ctrl-C reaches the whole foreground group; but the launcher decides when the recording is complete.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICENESS)
    from rack.backplane.segment import Segment
    from rack.tools.recorder.recorder import Recorder, SafeSink

    with suppress(ImportError):
        import rack.tools.viewer.sink  # noqa: F401  takes a second, while the rack is being launched
    line = sys.stdin.readline()
    if not line:
        return
    name, folder, port = json.loads(line)
    segment = Segment.attach(name)
    view = SafeSink(lambda: _view(segment, Path(folder), port), _tell)
    with Recorder(segment, Path(folder), view) as recorder:
        _tell("recording")
        recorder.follow(until=sys.stdin.fileno())


def _view(segment: Segment, folder: Path, port: int | None) -> Sink:
    from rack.tools.viewer.sink import ViewSink

    return ViewSink(segment, folder, port)


def _tell(text: str) -> None:
    # The launcher may be gone; the files are finished all the same.
    with suppress(OSError):
        print(text, flush=True)


if __name__ == "__main__":
    main()
