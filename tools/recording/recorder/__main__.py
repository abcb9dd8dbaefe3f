"""The recorder process, `python -m rack.tools.recording.recorder`.

Its argument names the class of the view, "package.module:Class". Its stdin names rack and folder,
and closes when the run is over. It prints "recording" once it has attached; every other line is a
message for the user.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from rack.levels.references import module_and_name

if TYPE_CHECKING:
    from rack.backplane.segment import Segment
    from rack.tools.recording.recorder.recorder import Sink

NICENESS = 5
"""On a shared core, boards go first, even those without real-time priority. No more than
that: next to three busy programs a core, niceness 10 leaves a thirtieth of it; a recorder needs a
tenth."""


def main() -> None:
    """Attach to the rack that one line of JSON names, and record until stdin closes; another line
    means: in a hurry.
    """
    # Ctrl-C reaches the whole foreground group; but the launcher decides when the recording is
    # complete.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICENESS)
    launcher = os.getppid()
    from rack.backplane.segment import Segment
    from rack.backplane.words import System
    from rack.tools.recording.recorder.process import UNWRITABLE, unwritable
    from rack.tools.recording.recorder.recorder import Recorder, SafeSink

    # It takes half a second. A thread begins with it while the rack is being launched.
    Thread(target=_import_view, daemon=True).start()
    line = sys.stdin.readline()
    if not line:
        return
    name, folder, port = json.loads(line)
    segment = Segment.attach(name)
    view = SafeSink.of(segment, port, lambda: _view(segment, Path(folder), port), _tell)
    try:
        with Recorder(segment, Path(folder), view) as recorder:
            _tell("recording")
            recorder.follow(until=sys.stdin.fileno())
            if segment.run_is_over:
                # No board is left to give way to; but only root may take its niceness back.
                with suppress(PermissionError):
                    os.nice(-NICENESS)
            # Nobody waits for the viewer's file if the launcher was killed. On a loaded machine its
            # libraries alone may take a minute; `rack replay` makes it.
            is_hurried = sys.stdin.readline() or os.getppid() != launcher
            if is_hurried and view is not None:
                view.hurry()
    except OSError as error:
        tick = segment.words[System.FOLLOWER_TICK]
        print(unwritable(Path(folder), error, tick), file=sys.stderr, flush=True)
        os._exit(UNWRITABLE)


def _import_view() -> None:
    # If it is not there, opening the view says so.
    with suppress(LookupError):
        module_and_name(sys.argv[1])


def _view(segment: Segment, folder: Path, port: int | None) -> Sink:
    module, name = module_and_name(sys.argv[1])
    sink: Sink = getattr(module, name)(segment, folder, port)
    return sink


def _tell(text: str) -> None:
    # The launcher may be gone; the files are finished all the same.
    with suppress(OSError):
        print(text, flush=True)


if __name__ == "__main__":
    main()
    # All files are complete. To take the interpreter apart under a thread that still imports could
    # crash it.
    os._exit(0)
