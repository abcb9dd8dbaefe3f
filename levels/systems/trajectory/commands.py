"""A host-side command environment: motions as Python calls, in a script or at a prompt.

    move(joints)                  a straight line in joint space
    line(position, ...)           a straight line of the tool, in the world's frame or a body's
    stay(seconds), grip(opening)  stay at the goal; move the gripper
    cancel()                      drop all requests; the arm ramps to rest
    done(), wait()                test whether all requests have ended; wait until they have

A call returns as soon as its request is queued, and blocks only while the queue is full. Successive
motions are blended. A request may be lost with a board that dies while it holds the request; the
next call that waits sends it again.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from rack.levels.errors import LevelError, RunOver
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
"""Orientation of a tool that points straight down, as quaternion w, x, y, z."""
POLL_S = 0.25
"""Longest wait before the status is read again, s."""
RESEND_DELAY_S = 2.0
"""Time after which open requests are sent again if none of them is being executed, s."""
WORLD_BODY = -1
"""Body number of a goal in the frame of the world."""


class Motions:
    """Methods that request motions. Each returns the number of its request.

    Scripts and prompts use the public methods by name. Requests that an earlier process of the
    board left in the queue are cancelled first.
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
        # Every request of an earlier process has a number up to the count of messages sent.
        self._newest = requests.sent
        self._open_requests: dict[
            int, dict[str, Any]
        ] = {}  # requests that have not ended, by number
        # Time at which requests were first seen open with none under way, s.
        self._idle_since: float | None = None
        if self._newest:
            self.cancel()

    def move(self, joints: Sequence[float] | None = None, **times: float) -> int:
        """Move in a straight line in joint space.

        Args:
            joints: Goal, (joints,), rad. None moves to the home position.
            **times: Fields `segment` and `acceleration` of the request, s.
        """
        goal = self._robot.home if joints is None else joints
        return self._queue_request(kind=MotionKind.JOINTS, joints=goal, **times)

    def line(
        self,
        position: Sequence[float],
        quaternion: Sequence[float] = DOWN,
        body: str = "",
        live: bool = False,
        guard: float = 0.0,
        **times: float,
    ) -> int:
        """Move the tool in a straight line to a pose.

        Args:
            position: Goal of the tool, m, in the frame of `body`.
            quaternion: Orientation of the tool, w, x, y, z, in the same frame.
            body: Object or obstacle in whose frame the goal is. Empty for the world.
            live: Whether the goal follows the body. Otherwise its frame is copied when the motion
                begins.
            guard: Change of any joint's torque, N m, at which the motion ends GUARDED, because the
                arm has touched something. 0 for no guard.
            **times: Fields `segment` and `acceleration` of the request, s.

        Returns:
            Number of the request.

        Raises:
            LevelError: If the body is not in the scene.
        """
        if body and body not in self._bodies:
            raise LevelError(
                f"line: body = {body}: not in the scene; its bodies are {', '.join(self._bodies)}"
            )
        frame = self._bodies.index(body) if body else WORLD_BODY
        return self._queue_request(
            kind=MotionKind.POSE,
            position=position,
            quaternion=quaternion,
            body=frame,
            live=live,
            touch=guard,
            **times,
        )

    def stay(self, seconds: float) -> int:
        """Stay at the previous goal for `seconds`. If the goal is live, keep following it."""
        return self._queue_request(kind=MotionKind.STAY, segment=seconds)

    def grip(self, opening: float | None = None, force: float | None = None) -> int:
        """Move the gripper to `opening`, in m, with at most `force`, in N. By default it closes."""
        if opening is None:
            opening = self._gripper.closed
        if force is None:
            force = self._gripper.force
        return self._queue_request(kind=MotionKind.GRIP, opening=opening, force=force)

    def release(self) -> int:
        """Open the gripper."""
        return self.grip(self._gripper.open)

    @property
    def _gripper(self) -> GripperConfig:
        """The gripper of the arm. Raises `LevelError` if it has none."""
        if self._robot.gripper is None:
            raise LevelError("grip: the arm has no gripper")
        return self._robot.gripper

    def cancel(self) -> int:
        """End the current motion and drop all queued ones. The arm ramps to rest."""
        return self._queue_request(kind=MotionKind.CANCEL)

    def end_of(self, request: int) -> RequestEnd:
        """Return how a request ended. NONE if it is still open or no longer listed."""
        status = self._status
        ends = dict(zip(status.ended.tolist(), status.ends.tolist(), strict=True))
        return RequestEnd(ends.get(request, RequestEnd.NONE))

    def done(self, request: int | None = None) -> bool:
        """Return True if a request, by default the newest, has ended."""
        return bool(self._status.done >= (self._newest if request is None else request))

    def wait(self, request: int | None = None, until: Callable[[], bool] = lambda: False) -> bool:
        """Wait until a request, by default the newest, has ended.

        Returns:
            True if the request has ended. False if `until()` returned True or the run ended first.
        """
        while not self.done(request):
            if until() or self._bus.is_over:
                return False
            self._wait_and_resend()
        return True

    def where(self) -> list[float]:
        """Return the newest commanded position of the tool, in m."""
        return [round(float(x), 4) for x in self._status.tool]

    @property
    def _status(self) -> MotionStatus:
        """Newest status of the level that moves the arm."""
        return self._motion.read().message

    def _queue_request(self, **fields: Any) -> int:
        """Queue a request, waiting while the queue is full, and return its number."""
        request = {"body": WORLD_BODY, **fields, "id": self._newest + 1}
        while not self._send_request(request):
            if self._bus.is_over:
                raise RunOver("the run is over")
            self._wait_and_resend()
        self._newest += 1
        self._open_requests[self._newest] = request
        return self._newest

    def _send_request(self, fields: Mapping[str, Any]) -> bool:
        """Send a request with these fields, all others being zero.

        Returns False if the queue is full. Raises `AttributeError` for an unknown field.
        """
        request = self._requests.message
        # The message still contains the fields of a request that could not be sent.
        request.clear()
        for name, value in fields.items():
            setattr(request, name, value)
        return self._requests.send()

    def _wait_and_resend(self) -> None:
        """Wait for `POLL_S`. Send open requests again if none was executed for `RESEND_DELAY_S`."""
        self._bus.wait(POLL_S)
        status = self._status
        now = self._bus.time_s
        self._open_requests = {
            number: request
            for number, request in self._open_requests.items()
            if number > status.done
        }
        if status.current or not self._open_requests:
            self._idle_since = None
        elif self._idle_since is None:
            self._idle_since = now
        elif now - self._idle_since > RESEND_DELAY_S:
            self._idle_since = None
            # A request that was still in the queue is now queued twice, but executed once.
            for request in self._open_requests.values():
                self._send_request(request)


class ScriptParams(Table):
    """`[host.<name>.params]`: the script of a command environment."""

    script: str
    """Python script to run, found in a folder of python_path"""


class CommandEnvironment(HostProgram):
    """Host program that runs a script of motion calls. A prompt offers the same names."""

    motion = ProgramInput(MotionStatus, "below.motion")
    requests = ProgramOutput(MotionRequest)
    params: ClassVar[type[ScriptParams]] = ScriptParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._script = read_params(self.params, context.params).script

    def run(self, bus: Bus) -> None:
        """Run the script. Raises `LevelError` if no folder of `sys.path` contains it."""
        paths = [Path(folder) / self._script for folder in sys.path]
        script = next(filter(Path.is_file, paths), None)
        if script is None:
            raise LevelError(f"params.script = {self._script}: not in a folder of python_path")
        runpy.run_path(
            str(script), {"bus": bus, "program": self, **self.list_prompt_names(bus)}, "__main__"
        )

    def list_prompt_names(self, bus: Bus) -> Mapping[str, Any]:
        """Return a dictionary from names to the calls that a script may use."""
        motions = self.motions(bus)
        calls = {name: getattr(motions, name) for name in dir(motions) if name[0] != "_"}
        return {"motions": motions, **calls}

    def motions(self, bus: Bus) -> Motions:
        """Build the object whose methods queue motion requests."""
        return Motions(bus, self.motion, self.requests, self.context)
