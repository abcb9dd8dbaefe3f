"""`rack bridge`: connect a running rack to another tool."""

from __future__ import annotations

import os
import sys
from contextlib import closing

from rack.backplane.segment import Segment
from rack.tools.bridges.bridge import BRIDGES, run_bridge
from rack.tools.console.answer import Failure
from rack.tools.console.parameters import RackName, argument

NICENESS = 5
"""Niceness of a bridge, as that of the recorder."""


def bridge(
    rack: RackName,
    name: str = argument("BRIDGE", f"{', '.join(BRIDGES)}, or your own: package.module:Class"),
) -> None:
    """Connect a running rack to another tool, until its run is over or until Ctrl-C.

    \b
    ros2      nodes of ROS 2 see the rack and can stop it; ROS itself is not needed
    foxglove  Foxglove shows the cell, curves, timing and the log

    'rack run --ros2' and 'rack run --foxglove' do the same from the first tick on. A bridge reads
    the same rings as the recorder, and causes no missed deadlines. The rack goes on if it ends.

    RMW_IMPLEMENTATION (rmw_zenoh_cpp or rmw_cyclonedds_cpp), ROS_DOMAIN_ID, CYCLONEDDS_URI and
    ZENOH_SESSION_CONFIG_URI have the same meaning as in ROS. FOXGLOVE_PORT is the port for
    Foxglove, 8765 by default.

    Exit status: 0 the run is over; 1 there is no such rack, or the connection failed; 2 usage.

    \b
    Examples:
      rack bridge nasrem ros2
      rack bridge nasrem foxglove
      rack bridge nasrem my_package.bridges:MyBridge
    """

    def tell(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    with closing(Segment.attach(rack)) as segment:
        if segment.run_is_over:
            raise Failure(f"rack '{rack}': its run is over")
        os.nice(NICENESS)
        run_bridge(name, segment, tell)
