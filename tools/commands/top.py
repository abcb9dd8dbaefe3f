"""`rack top`: watch a running rack until its end."""

from __future__ import annotations

import sys
import threading
from contextlib import closing
from importlib.util import find_spec

from rack.tools.commands.status import OnlyRack, find_only_rack
from rack.tools.console.interrupt import INTERRUPT

SNAPSHOT_INTERVAL_S = 0.2
"""Time between two snapshots."""


def top(rack: OnlyRack = None) -> None:
    """Watch a running rack until its run is over, or until Ctrl-C.

    On a terminal the view fills the screen, if textual is installed (pip install
    'nasrem-rack[live]'), and keys command the rack. Elsewhere one line a second is printed.
    Watching causes no missed deadlines. When the view is closed, the run continues, and commands
    given from it stay in force.

    To watch a rack on another machine: ssh -t HOST rack top.

    \b
    1 2 3 4  boards, mailboxes, events, lateness
    l        select the level that keys command, shown in reverse
    h r      hold it, let it resume
    c        type a command, as in: task goto home
    i        choose a fault, change it, inject it
    e E      set the emergency stop, reset it
    w q      reset the longest times, quit

    \b
    Examples:
      rack top
      rack top nasrem
    """
    from rack.backplane.segment import Segment
    from rack.tools.console.tables import create_console
    from rack.tools.monitor.display import open_display
    from rack.tools.monitor.snapshot import RackMonitor

    ended = threading.Event()
    with (
        INTERRUPT.stop_orderly(ended.set),
        closing(Segment.attach(rack or find_only_rack())) as segment,
    ):
        if create_console().is_terminal and sys.stdin.isatty():
            if find_spec("textual") is not None:
                from rack.tools.monitor.full_screen import RackScreen

                screen = RackScreen(segment, ended.is_set)
                screen.run()
                sys.exit(screen.return_code)
            print(
                "no full screen without textual: pip install 'nasrem-rack[live]'", file=sys.stderr
            )
        monitor = RackMonitor(segment)
        with open_display(False, sys.stdout) as display:
            display.show(monitor.take_snapshot())
            while not segment.run_is_over and not ended.wait(SNAPSHOT_INTERVAL_S):
                display.show(monitor.take_snapshot())
