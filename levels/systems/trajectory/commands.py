"""A command environment on the host side: motions as plain Python calls, in a script or at a
prompt.

    move(joints)                  a straight line in joint space
    line(position, ...)           a straight line of the tool, in the world's frame or a body's
    stay(seconds), grip(opening)  at rest
    cancel()                      drop everything; the arm ramps to rest
    done(), wait()                whether all is done; wait until it is

A call returns as soon as its request is on its way: requests are queued, and blended. It waits only
while the queue is full. A request that is lost, with a board that died as it held it, is sent again
by the next call that waits.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rack.levels.errors import LevelError
from rack.levels.host_program import (
    Bus,
    HostProgram,
    HostReceiver,
    HostSender,
    ProgramInput,
    ProgramOutput,
)
from rack.levels.level import LevelContext
from rack.levels.systems.trajectory.messages import (
    MotionKind,
    MotionRequest,
    MotionStatus,
    RequestEnd,
)
from rack.levels.tables import GripperConfig, Table, read_params

DOWN = (0.0, 1.0, 0.0, 0.0)
"""Orientation of a tool that points straight down, w, x, y, z."""
LOOK_S = 0.25
PATIENCE_S = 2.0
"""Time for which nothing is under way, though requests are open, before they are sent again."""
WORLD = -1


class Motions:
    """Motion requests as calls: scripts and prompts have its public methods by name. A request
    returns its number.

    What a former process of the board has left in the queue is cancelled first.
    """

    def __init__(
        self,
        bus: Bus,
        motion: HostReceiver[MotionStatus],
        requests: HostSender[MotionRequest],
        context: LevelContext,
    ) -> None:
        self._bus = bus
        self._motion = motion
        self._requests = requests
        self._robot = context.robot
        self._bodies = context.scene.bodies
        # No request of a former process has a greater number than it has sent messages.
        self._newest = requests.sent
        self._open: dict[int, dict[str, Any]] = {}  # requests that have not ended, by number
        # Time since when nothing is under way, though requests are open.
        self._idle_since: float | None = None
        if self._newest:
            self.cancel()

    def move(self, joints: Sequence[float] | None = None, **times: float) -> int:
        """Go to joint positions, rad, in a straight line in joint space; default: home."""
        goal = self._robot.home if joints is None else joints
        return self._request(kind=MotionKind.JOINTS, joints=goal, **times)

    def line(
        self,
        position: Sequence[float],
        quaternion: Sequence[float] = DOWN,
        body: str = "",
        live: bool = False,
        guard: float = 0.0,
        **times: float,
    ) -> int:
        """Move the tool to a pose, m, in a straight line; in the frame of a `body`, which a `live`
        goal follows.

        With a `guard`, N m, it ends GUARDED where a joint's torque changes by more: the arm met
        something.
        """
        if body and body not in self._bodies:
            raise LevelError(
                f"line: body = {body}: not in the scene; permitted: {', '.join(self._bodies)}"
            )
        frame = self._bodies.index(body) if body else WORLD
        return self._request(
            kind=MotionKind.POSE,
            position=position,
            quaternion=quaternion,
            body=frame,
            live=live,
            touch=guard,
            **times,
        )

    def stay(self, seconds: float) -> int:
        """Stay at the goal before."""
        return self._request(kind=MotionKind.STAY, segment=seconds)

    def grip(self, opening: float | None = None, force: float | None = None) -> int:
        """Bring the gripper to an opening, m, with at most `force`, N; default: close it."""
        if opening is None:
            opening = self._gripper.closed
        if force is None:
            force = self._gripper.force
        return self._request(kind=MotionKind.GRIP, opening=opening, force=force)

    def release(self) -> int:
        """Open the gripper."""
        return self.grip(self._gripper.open)

    @property
    def _gripper(self) -> GripperConfig:
        if self._robot.gripper is None:
            raise LevelError("grip: the arm has no gripper")
        return self._robot.gripper

    def cancel(self) -> int:
        """End the motion under way and drop all others; the arm ramps to rest."""
        return self._request(kind=MotionKind.CANCEL)

    def end_of(self, request: int) -> RequestEnd:
        """Return how a request ended: NONE until it has, or if it is too long ago."""
        status = self._status
        ends = dict(zip(status.ended.tolist(), status.ends.tolist(), strict=True))
        return RequestEnd(ends.get(request, RequestEnd.NONE))

    def done(self, request: int | None = None) -> bool:
        """Return whether a request, by default the newest, has ended."""
        number = self._newest if request is None else request
        return bool(self._status.done >= number)

    def wait(self, request: int | None = None, until: Callable[[], bool] = lambda: False) -> bool:
        """Wait until a request, by default the newest, has ended; False if `until` holds before, or
        the run ends.
        """
        while not self.done(request):
            if until() or self._bus.is_over:
                return False
            self._look()
        return True

    def where(self) -> list[float]:
        """Return the tool position commanded last, m."""
        return [round(float(x), 4) for x in self._status.tool]

    @property
    def _status(self) -> MotionStatus:
        """The newest status of the level that moves the arm."""
        return self._motion.read().message

    def _request(self, **fields: Any) -> int:
        request = {"body": WORLD, **fields, "id": self._newest + 1}
        while not self._send(request):
            if self._bus.is_over:
                raise LevelError("the run is over")
            self._look()
        self._newest += 1
        self._open[self._newest] = request
        return self._newest

    def _send(self, fields: Mapping[str, Any]) -> bool:
        """Send a request with these fields, all others 0. Raises `AttributeError` for an unknown
        field.
        """
        request = self._requests.message
        # One that was refused, or had an unknown field, has left its fields.
        request.clear()
        for name, value in fields.items():
            setattr(request, name, value)
        return self._requests.send()

    def _look(self) -> None:
        """Wait for news; send the requests again that are lost: nothing is under way, and not all
        are done.
        """
        self._bus.wait(LOOK_S)
        status = self._status
        now = self._bus.time_s
        self._open = {
            number: request for number, request in self._open.items() if number > status.done
        }
        if status.current or not self._open:
            self._idle_since = None
        elif self._idle_since is None:
            self._idle_since = now
        elif now - self._idle_since > PATIENCE_S:
            self._idle_since = None
            # One that only waits is there twice then, and done once.
            for request in self._open.values():
                self._send(request)


class ScriptParams(Table):
    """`[host.<name>.params]`: the script of a command environment."""

    script: str
    """Python script to run, in a folder of python_path"""


class CommandEnvironment(HostProgram):
    """Runs a script that commands motions by name; a prompt offers the same names."""

    motion = ProgramInput(MotionStatus, "below.motion")
    requests = ProgramOutput(MotionRequest)
    params = ScriptParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._script = read_params(ScriptParams, context.params).script

    def run(self, bus: Bus) -> None:
        """Run the script; raises `LevelError` if there is no such file."""
        paths = [Path(folder) / self._script for folder in sys.path]
        script = next(filter(Path.is_file, paths), None)
        if script is None:
            raise LevelError(f"params.script = {self._script}: not in a folder of python_path")
        runpy.run_path(str(script), {"bus": bus, "program": self, **self.names(bus)}, "__main__")

    def names(self, bus: Bus) -> Mapping[str, Any]:
        """Return the calls, by name."""
        motions = self.motions(bus)
        calls = {name: getattr(motions, name) for name in dir(motions) if name[0] != "_"}
        return {"motions": motions, **calls}

    def motions(self, bus: Bus) -> Motions:
        """Return what makes requests of calls."""
        return Motions(bus, self.motion, self.requests, self.context)
