"""A bridge reads the rings of a running rack, as the recorder does, so no board waits for it.

The bridges in `BRIDGES` are known by name. Any other subclass of `RackBridge` is named to `rack
bridge` as "package.module:Class". A bridge is imported only when it is used.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import closing

import numpy as np

from rack.backplane.segment import Segment
from rack.levels.references import find_class
from rack.tools.console.answer import Failure
from rack.tools.monitor.polling import poll_run
from rack.tools.recording.spool import open_rings

BRIDGES = {
    "ros2": "rack.tools.bridges.ros2:Ros2Bridge",
    "foxglove": "rack.tools.bridges.foxglove:FoxgloveBridge",
}
"""Class of each bridge. Its name is also that of the extra that installs its libraries."""
PERIOD_S = 0.02
"""Time between two readings of the rings. The rings hold 2 s."""

Tell = Callable[[str], None]
"""Function that shows the user a line."""


class RackBridge(ABC):
    """A connection of one rack to another tool.

    The constructor opens it, or raises `Failure`. The first line that it shows reports success.

    Args:
        segment: The rack.
        tell: Shows the user a line.
    """

    rings: Sequence[str] = ()
    """Tasks and mailboxes whose rows the bridge shows."""

    @abstractmethod
    def __init__(self, segment: Segment, tell: Tell) -> None: ...

    @abstractmethod
    def show_rows(self, ring: str, rows: np.ndarray) -> None:
        """Show new rows of a ring, at least one, oldest first."""

    @abstractmethod
    def advance(self, tick: int) -> None:
        """Continue after all rows written before `tick` have been shown."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""


def run_bridge(name: str, segment: Segment, tell: Tell) -> None:
    """Run a bridge until the run of the rack is over, or until a signal.

    Args:
        name: Name of the bridge, or "package.module:Class".
        segment: The rack.
        tell: Shows the user a line.

    Raises:
        Failure: There is no such bridge, a library is missing, or the connection failed.
    """
    bridge_class = None
    try:
        bridge_class = find_class(BRIDGES.get(name, name), RackBridge)
        with closing(bridge_class(segment, tell)) as bridge:
            _show_run(bridge, segment)
    except Failure:
        raise
    except Exception as error:
        # A bridge may choose and import a library only in its constructor.
        if name in BRIDGES and isinstance(error.__cause__, ImportError):
            why = f"{error.__cause__.name} is missing: pip install 'nasrem-rack[{name}]'"
            raise Failure(why) from None
        if bridge_class is None:
            known = ", ".join(BRIDGES)
            raise Failure(f"{error}; known bridges: {known}, or package.module:Class", 2) from None
        raise Failure(f"{type(error).__name__}: {error}") from error


def _show_run(bridge: RackBridge, segment: Segment) -> None:
    """Pass the rows of the rings to a bridge until the run is over."""
    rings = {ring: rows for ring, rows in open_rings(segment).items() if ring in bridge.rings}
    for ring in rings.values():
        # Begin with the present, not with the two seconds that the rings still hold.
        ring.read_new_rows()
    for _ in poll_run(segment, PERIOD_S):
        tick = segment.tick
        for name, ring in rings.items():
            if len(rows := ring.read_new_rows().rows):
                bridge.show_rows(name, rows)
        bridge.advance(tick)
