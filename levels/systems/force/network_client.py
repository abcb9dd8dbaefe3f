"""A client of a force and motion server, as a process of its own, on this or another machine.

    python -m rack.levels.systems.force.network_client 127.0.0.1:7260 configs/penn/wipe.py

The script has the calls of `rack.levels.systems.force.client`. All that the client needs to know of
arm, scene and task comes from the server. Exit status: 0 the script succeeded; 1 it failed, or
there is no server; 2 usage.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from rack.levels.errors import LevelError
from rack.levels.host_program import Bus
from rack.levels.level import LevelContext, Reading, Verdict
from rack.levels.systems.force.client import ForceClient
from rack.levels.systems.force.frames import (
    TICK_AND_TIME,
    TIMEOUT,
    Connection,
    FrameKind,
    NetworkFrame,
    await_sockets,
)
from rack.levels.systems.force.messages import ServerRequest, ServerStatus
from rack.levels.systems.force.network_server import parse_address
from rack.levels.tables import RobotConfig, SceneConfig

CONNECT_S = 10.0
"""Longest wait for the server to begin, and for the network at the end."""


class RemoteServer:
    """The server at the other end: bus and ports of a `ForceClient`.

    Args:
        address: IPv4 address and port of the server.
        script: Script that the client will run.

    Attributes:
        context: Context of the client's program.
        message: The next request.
        sent: Number of requests sent by this and earlier clients.

    Raises:
        LevelError: There is no server, or it refuses the client.
    """

    def __init__(self, address: tuple[str, int], script: str) -> None:
        try:
            self._connection = Connection(socket.create_connection(address, CONNECT_S))
        except OSError as error:
            where = "{}:{}".format(*address)
            raise LevelError(f"no server at {where}: {error.strerror or error}") from None
        hello = self._receive_frame(CONNECT_S)
        if hello is None or hello.kind is not FrameKind.HELLO:
            raise LevelError(f"{self._connection.peer} has not said that it is a server")
        known = json.loads(hello.content)
        self.is_paced: bool = known["is_paced"]
        self.is_over = False
        self.sent: int = known["sent"]
        self.context = LevelContext(
            board=known["board"],
            every=1,
            within_cycles=1,
            clock_ns=known["clock_ns"],
            seed=0,
            robot=RobotConfig.model_validate(known["robot"]),
            scene=SceneConfig.model_validate(known["scene"]),
            task=known["task"],
            sizes=known["sizes"],
            params={"script": script},
        )
        self.message = ServerRequest.zeros(known["sizes"])
        self._status = ServerStatus.zeros(known["sizes"])
        self._verdict = Verdict.NONE
        self._tick = 0  # of the newest frame
        self._time_s = 0.0  # simulated time of that frame
        self._received_s = time.monotonic()
        self._await_status(CONNECT_S)

    @property
    def tick(self) -> int:
        """Tick of the rack. In real time it is estimated from the newest frame."""
        passed_s = 0.0 if self.is_paced else time.monotonic() - self._received_s
        return self._tick + int(passed_s / self.context.tick_s)

    @property
    def time_s(self) -> float:
        """Time in s: simulated time in lockstep, the client's own clock in real time."""
        return self._time_s if self.is_paced else time.monotonic()

    def wait(self, timeout_s: float) -> bool:
        """Wait until a status arrives. Return False after the time-out or at the end of the run."""
        if self.is_paced:
            self._connection.send(FrameKind.WAIT, TIMEOUT.pack(timeout_s))
            return self._await_status(None)
        return self._await_status(timeout_s)

    def read(self) -> Reading[ServerStatus]:
        """Return the newest status."""
        return Reading(self._status, self._verdict)

    def send(self) -> bool:
        """Send `message` and clear it. Return False while the network takes nothing more."""
        if not self._connection.flush():
            return False
        self._connection.send(FrameKind.REQUEST, self.message.record.tobytes())
        self.message.clear()
        self.sent += 1
        return True

    def finish(self, reason: str = "") -> None:
        """Tell the server that the script has ended, and why if it has failed."""
        self._connection.send(FrameKind.END, reason.encode())
        self._connection.close(CONNECT_S)

    def _await_status(self, timeout_s: float | None) -> bool:
        """Take frames up to the newest status. Return False if none arrives within the time."""
        frame = self._receive_frame(timeout_s)
        has_arrived = frame is not None
        while frame is not None:
            if frame.kind is FrameKind.END:
                self.is_over = True
                return False
            self._tick, self._time_s = TICK_AND_TIME.unpack_from(frame.content)
            self._received_s = time.monotonic()
            if status := frame.content[TICK_AND_TIME.size :]:
                self._status.record[...] = np.frombuffer(status, self._status.record.dtype)[0]
                self._verdict = Verdict.NEW
            frame = self._receive_frame(0.0)
        return has_arrived

    def _receive_frame(self, timeout_s: float | None) -> NetworkFrame | None:
        """Return the next frame. None if none arrives within `timeout_s`; None waits for ever.

        Raises:
            LevelError: The connection is closed, or the server refuses the client.
        """
        connection = self._connection
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            if (frame := connection.take_frame()) is not None:
                if frame.kind is not FrameKind.END or not frame.content:
                    return frame
                connection.close()
                raise LevelError(f"{connection.peer}: {frame.content.decode()}")
            left_s = None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
            unsent = [] if connection.flush() else [connection.socket]
            ready = await_sockets([connection.socket], left_s, unsent)
            if ready and not connection.receive():
                connection.close()
                raise LevelError(f"the server at {connection.peer} has closed the connection")
            if left_s == 0.0 and not ready:
                return None


def run_client(address: tuple[str, int], script: str) -> None:
    """Run a script with the calls of a client. Exceptions of the script are passed on.

    Args:
        address: IPv4 address and port of the server.
        script: File, or name of a file in a folder of the module search path.
    """
    server = RemoteServer(address, script)
    program = ForceClient(server.context)
    ports: dict[str, Any] = vars(program)
    ports["motion"] = ports["requests"] = server
    try:
        # It lacks access to the memory of the rack, which the calls of a client do not need.
        program.run(cast("Bus", server))
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}, line {place.lineno}"
        server.finish(f"{type(error).__name__}: {error} ({where})")
        raise
    server.finish()


def main(arguments: Sequence[str]) -> int:
    """Run the command, and return its exit status."""
    try:
        address, script = arguments
        place = parse_address(address)
    except ValueError as error:
        usage = "usage: python -m rack.levels.systems.force.network_client ADDRESS:PORT SCRIPT"
        print(f"{usage} ({error})", file=sys.stderr)
        return 2
    path = Path(script)
    try:
        run_client(place, str(path.resolve()) if path.is_file() else script)
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except Exception as error:
        print(f"{script}: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
