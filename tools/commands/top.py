"""`rack top`: a running rack, looked at again and again."""

from __future__ import annotations

import threading

from rack.tools.console.address import OPERATOR, Asker
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import AnyRackName, AskAs, Certificates

LOOK_S = 0.2
"""Time from look to look: short, so that the end of a run on another machine is still seen."""


def top(rack: AnyRackName, certificates: Certificates = "", name: AskAs = OPERATOR) -> None:
    """Watch a running rack until its run is over, or until Ctrl-C.

    On a terminal the table of `rack status` changes in place; elsewhere one line a second is
    printed. Watching costs the rack no deadline, and ending it does not end the run.

    \b
    Examples:
      rack top nasrem
      rack top 192.168.1.5/cell --certificates ~/cell
    """
    from rack.tools.live.display import display_for
    from rack.tools.live.snapshot import RackMonitor
    from rack.tools.live.watched import watched

    ended = threading.Event()
    with INTERRUPT.orderly(ended.set), watched(rack, Asker.of(name, certificates)) as one:
        monitor = RackMonitor(one.segment)
        with display_for(silent=False) as display:
            display.show(monitor.look())
            while not one.segment.run_is_over and not ended.wait(LOOK_S):
                one.refresh()
                display.show(monitor.look())
