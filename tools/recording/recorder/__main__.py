"""The recorder process, `python -m rack.tools.recording.recorder`.

Its argument names the class of the view, "package.module:Class". The view is the sink that writes
the viewer's file. The first line on stdin names the rack and the folder of the run. The launcher
closes stdin when the run is over. The recorder prints "recording" once it has attached. Every other
line that it prints is a message to the user.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from rack.backplane.process import write_line
from rack.levels.references import import_reference

if TYPE_CHECKING:
    from rack.backplane.segment import Segment
    from rack.tools.recording.recorder.recorder import Sink

NICENESS = 5
"""Niceness of the recorder.

On a shared core, boards run before the recorder, even boards without real-time priority. A higher
value would starve the recorder: next to three busy programs per core, niceness 10 leaves it a
thirtieth of the core, but it needs a tenth.
"""


def main() -> None:
    """Attach to the rack named by a line of JSON on stdin, and record until stdin closes.

    A second line on stdin ends the recording, and asks the recorder not to wait for the viewer's
    file.
    """
    # Ctrl-C reaches the whole foreground group, but the launcher decides when recording ends.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICENESS)
    launcher = os.getppid()
    from rack.backplane.segment import Segment
    from rack.backplane.words import System
    from rack.tools.recording.occasions import Retention
    from rack.tools.recording.recorder.process import UNWRITABLE, format_write_failure
    from rack.tools.recording.recorder.recorder import Recorder, SafeSink

    # The import takes half a second, so a thread does it while the rack is being launched.
    Thread(target=_import_view, daemon=True).start()
    line = sys.stdin.readline()
    if not line:
        return
    name, folder, port = json.loads(line)
    segment = Segment.attach(name)
    view = None
    # A flight recorder writes no file for the viewer: `rack replay` makes it later, from the
    # stretches that were kept.
    if port is not None or Retention.from_config(segment) is None:
        # The viewer's libraries may take long to load, or hang on a full disk, so a run does not
        # wait for them, unless the user wants to watch from the start.
        opened = partial(_open_view, segment, Path(folder), port)
        view = SafeSink(opened, _print_message, in_background=port is None)
    try:
        with Recorder(segment, Path(folder), view) as recorder:
            _print_message("recording")
            recorder.record_until(until=sys.stdin.fileno())
            if segment.run_is_over:
                # No board needs the core any more. Only root may lower the niceness again.
                with suppress(PermissionError):
                    os.nice(-NICENESS)
            # If the launcher was killed, do not wait for the viewer's file. Loading the viewer's
            # libraries may take a minute on a busy machine, and `rack replay` can make the file
            # later.
            is_hurried = sys.stdin.readline() or os.getppid() != launcher
            if is_hurried and view is not None:
                view.hurry()
    except OSError as error:
        tick = segment.words[System.FOLLOWER_TICK]
        write_line(sys.stderr, format_write_failure(Path(folder), error, tick))
        os._exit(UNWRITABLE)


def _import_view() -> None:
    """Import the module of the view, so that opening the view takes less time."""
    # A missing module is reported when the view is opened.
    with suppress(LookupError):
        import_reference(sys.argv[1])


def _open_view(segment: Segment, folder: Path, port: int | None) -> Sink:
    """Open the view that writes into `folder`, and serves a viewer if a port is given."""
    module, name = import_reference(sys.argv[1])
    sink: Sink = getattr(module, name)(segment, folder, port)
    return sink


def _print_message(text: str) -> None:
    """Print a line for the launcher, if it still runs."""
    # If the launcher was killed, the files must still be finished.
    with suppress(OSError):
        write_line(sys.stdout, text)


if __name__ == "__main__":
    main()
    # All files are complete. Shutting down the interpreter while a thread is still importing could
    # crash it.
    os._exit(0)
