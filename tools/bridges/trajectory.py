"""Joint trajectories of ROS 2 as motion requests to a trajectory level.

The bridge takes the place of the program of an external host board, as `rack prompt` does. Each
point of a trajectory becomes a request, which the bus adapter passes on at a tick and which is
recorded. So a run repeats with `rack run --entries`, and operators, holds and limits apply as to
any other request. The arm moves in straight lines in joint space, blended near the points.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any, NamedTuple

from rack.backplane.segment import Segment
from rack.boards.config.loader import load_text, read_stored
from rack.boards.config.resolved import resolve
from rack.boards.errors import format_value
from rack.boards.host.bus import HostBus
from rack.boards.wiring import HostWiring
from rack.levels.host_program import HostProgram
from rack.levels.references import find_class
from rack.levels.systems.trajectory.commands import CommandEnvironment
from rack.levels.systems.trajectory.messages import RequestEnd
from rack.tools.bridges.bridge import Tell
from rack.tools.ecosystem.ros_messages import STORE

TYPE = "trajectory_msgs/msg/JointTrajectory"
IGNORED = ("velocities", "accelerations", "effort")
"""Fields of a point that motion requests cannot express."""
MAX_BYTES = 1 << 20
"""Longest message that is taken from the network."""
AHEAD = 8
"""Number of requests that wait in the rack. A new trajectory never waits for their queue."""
MAX_HALF_BLEND_S = 0.3
"""Longest half of a blend."""
CHECK_S = 0.2
"""Longest time until the end of the run is noticed."""


class Point(NamedTuple):
    """A point of a trajectory: time since its start, s, and positions in the arm's order, rad."""

    time_s: float
    joints: list[float]


class RosTrajectory(NamedTuple):
    """Points of a trajectory, and the fields with values that cannot be followed."""

    points: list[Point]
    ignored: list[str]


def read_trajectory(data: bytes, joints: Sequence[str]) -> RosTrajectory:
    """Return an encoded `JointTrajectory`.

    Args:
        data: The message as CDR, from an untrusted sender.
        joints: Names of the arm's joints.

    Raises:
        ValueError: The message has a mistake.
    """
    if len(data) > MAX_BYTES:
        raise ValueError(f"{len(data)} bytes; valid: up to {MAX_BYTES}")
    try:
        message: Any = STORE.deserialize_cdr(data, TYPE)
    except Exception as error:
        raise ValueError(f"{len(data)} bytes are not a {TYPE}") from error
    names = message.joint_names
    if sorted(names) != sorted(joints):
        given = format_value(", ".join(names))
        raise ValueError(f"joint_names = {given}: must be {', '.join(joints)}, in any order")
    order = [names.index(joint) for joint in joints]
    points: list[Point] = []
    before_s = -1e-9
    for at, point in enumerate(message.points):
        time_s = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
        for name in ("positions", *IGNORED):
            count = len(getattr(point, name))
            if count != len(joints) and (count or name == "positions"):
                raise ValueError(f"points[{at}].{name} has length {count}: must be {len(joints)}")
        if not before_s < time_s:
            raise ValueError(f"points[{at}].time_from_start = {time_s:g} s: must rise from 0 on")
        points.append(Point(time_s, point.positions[order].tolist()))
        before_s = time_s
    ignored = [name for name in IGNORED if any(getattr(p, name).any() for p in message.points)]
    return RosTrajectory(points, ignored)


def find_motion_board(segment: Segment) -> HostWiring | None:
    """Return the external host board that sends motion requests. None if the rack has none.

    The rack must belong to this user, because the config names the class of the board's program.
    """
    hosts = read_stored(segment.config).host.values()
    is_own = os.fstat(segment.fd).st_uid == os.getuid()
    if not is_own or not any(host.external for host in hosts):
        return None
    for wiring in resolve(load_text(segment.config)).hosts:
        program = find_class(wiring.target, HostProgram)
        if wiring.is_external and issubclass(program, CommandEnvironment):
            return wiring
    return None


class TrajectoryFollower:
    """Sends trajectories to the rack. A new trajectory replaces the one under way.

    Args:
        segment: The rack.
        wiring: Host board that the follower becomes.
        tell: Shows the user a line.

    Raises:
        MailboxError: Another process is the host board already.
    """

    def __init__(self, segment: Segment, wiring: HostWiring, tell: Tell) -> None:
        self._program = find_class(wiring.target, CommandEnvironment)(wiring.context)
        self._bus = HostBus(segment, wiring)
        self._bus.connect_ports(self._program)
        self._motions = self._program.motions(self._bus)
        self._joints = wiring.context.robot.joints
        self._tell = tell
        self._trajectories: SimpleQueue[list[Point]] = SimpleQueue()
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def take_message(self, data: bytes) -> None:
        """Follow the trajectory of a message, or report its mistake. Without points: stop."""
        try:
            points, ignored = read_trajectory(data, self._joints)
            if ignored:
                self._tell(f"/joint_trajectory without {', '.join(ignored)}: not supported")
            self._trajectories.put(points)
        except ValueError as error:
            self._tell(f"/joint_trajectory: {error}")

    def _has_newer(self) -> bool:
        return not self._trajectories.empty()

    def _run(self) -> None:
        """Follow one trajectory after the other until the run is over."""
        while not self._bus.is_over:
            try:
                points = self._trajectories.get(timeout=CHECK_S)
            except Empty:
                continue
            if not self._has_newer():
                self._follow_points(points)

    def _follow_points(self, points: Sequence[Point]) -> None:
        """Send the points, each when few requests wait, and report how the trajectory ended."""
        motions = self._motions
        requests = [motions.cancel()]
        before_s = 0.0
        for time_s, joints in points:
            motions.wait(requests[max(0, len(requests) - AHEAD)], self._has_newer)
            if self._has_newer() or self._bus.is_over:
                return
            segment_s = time_s - before_s
            half_blend_s = min(segment_s / 2.0, MAX_HALF_BLEND_S)
            requests.append(motions.move(joints, segment=segment_s, acceleration=half_blend_s))
            before_s = time_s
        if motions.wait(requests[-1], self._has_newer):
            outcome = motions.end_of(requests[-1])
            if outcome not in (RequestEnd.DONE, RequestEnd.NONE):
                status: Any = self._program.motion
                reason = status.read().message.reason
                self._tell(f"/joint_trajectory: {outcome.name.lower()}: {reason}")
                # Otherwise the level would refuse other requests, too.
                motions.cancel()

    def close(self) -> None:
        """Give the host board back. The rack completes the requests that it has."""
        self._bus.close()
