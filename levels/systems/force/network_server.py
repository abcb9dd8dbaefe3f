"""The host program that lets one client at a time command a force and motion server over TCP.

The client is a process that the rack does not schedule (`rack.levels.systems.force.network_client`)
and may be on another machine. With `script`, the program starts a client on this machine. Whatever
a client sends, the rack continues: requests beyond the ring of the bridge stay in the network,
invalid frames end the connection, and the level above the arm watches for signs of life.

In lockstep, time stands still until the client waits, and at the beginning until it connects.
Delays of the network then have no effect, and runs repeat.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from ipaddress import ip_address

from pydantic import field_validator

from rack.backplane.json_text import encode_json
from rack.levels.errors import LevelError
from rack.levels.host_program import Bus
from rack.levels.level import LevelContext
from rack.levels.systems.force.client import ForceClient
from rack.levels.systems.force.frames import (
    TICK_AND_TIME,
    TIMEOUT,
    Connection,
    FrameError,
    FrameKind,
    NetworkFrame,
    await_sockets,
)
from rack.levels.systems.trajectory.commands import ScriptParams

POLL_S = 0.005
"""Longest wait for frames in real time, after which statuses are sent."""
LOST_POLL_S = 0.02
"""Simulated time between two looks for a new client, in lockstep."""
SILENT_S = 2.0
"""Time without frames after which a new client may replace the present one."""
ENDING_S = 1.0
"""Longest wait for the end of the client that the program has started."""
MAX_REASON = 200
"""Longest reason of a client that is printed, in characters."""


class NetworkParams(ScriptParams):
    """`[host.<name>.params]`: where clients connect, and the client to start."""

    script: str = ""
    """script for a client on this machine, in a folder of python_path; default: none is started"""
    listen: str = "127.0.0.1:0"
    """IPv4 address and port for clients, which need no password; port 0: any that is free"""

    @field_validator("listen")
    @classmethod
    def _check_address(cls, listen: str) -> str:
        """Check that the text is an IPv4 address and a port."""
        parse_address(listen)
        return listen


def parse_address(text: str) -> tuple[str, int]:
    """Return the IPv4 address and the port in a text such as "127.0.0.1:7260".

    Raises:
        ValueError: The text has another form.
    """
    host, _, port = text.rpartition(":")
    with suppress(ValueError):
        if ip_address(host).version == 4 and port.isdecimal() and int(port) < 1 << 16:
            return host, int(port)
    raise ValueError(f"'{text}' must be an IPv4 address and a port, as in 127.0.0.1:7260")


@contextmanager
def _start_client(address: str, script: str) -> Iterator[subprocess.Popen[bytes] | None]:
    """Start a client with a script, and end it at the end. None if there is no script."""
    if not script:
        yield None
        return
    child = subprocess.Popen(
        [sys.executable, "-m", "rack.levels.systems.force.network_client", address, script],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.DEVNULL,
    )
    try:
        yield child
    finally:
        with suppress(subprocess.TimeoutExpired):
            child.wait(ENDING_S)
        child.kill()
        child.wait()


class NetworkServer(ForceClient):
    """Passes the requests of a client on the network to the bridge, and statuses to the client."""

    params = NetworkParams
    _bus: Bus
    _listener: socket.socket

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._child: subprocess.Popen[bytes] | None = None  # client that the program has started
        self._client: Connection | None = None
        self._had_client = False
        self._heard_s = 0.0  # time at which the client's newest frame arrived
        self._pending: NetworkFrame | None = None  # a request for which the ring has no place
        self._is_over = False  # the client has ended its program
        self._line = ""  # line that was printed last

    def run(self, bus: Bus) -> None:
        """Serve clients until one ends its program. Raises `LevelError` if the script fails."""
        settings = NetworkParams.model_validate(dict(self.context.params))
        self._bus = bus
        with socket.create_server(parse_address(settings.listen)) as self._listener:
            self._listener.setblocking(False)
            host, port = self._listener.getsockname()
            address = f"{host}:{port}"
            with _start_client(address, settings.script) as self._child:
                if self._child is None:
                    print(f"clients connect to {address}", flush=True)
                try:
                    self._serve_clients()
                finally:
                    self._drop_client(end=True)

    def _serve_clients(self) -> None:
        """Pass frames until a client ends its program or the run is over."""
        bus = self._bus
        while not bus.is_over:
            timeout_s = self._await_frames()
            if self._is_over:
                return
            is_asked = timeout_s is not None
            has_arrived = bus.wait(timeout_s or (LOST_POLL_S if bus.is_paced else 0.0))
            if self._client is not None and (is_asked if bus.is_paced else has_arrived):
                self._send_status(self._client)

    def _drop_client(self, reason: str = "", end: bool = False) -> None:
        """Close the connection to the client, if there is one.

        Args:
            reason: Line to print. Empty for none.
            end: Whether to send END first.
        """
        client = self._client
        self._client = self._pending = None
        if client is not None:
            if reason:
                self._print(f"client {client.peer}: {reason}")
            if end:
                client.send(FrameKind.END)
            client.close()

    def _print(self, line: str) -> None:
        """Print a line, unless it differs from the previous one at most in the client's port."""
        if line.split(": ", 1)[1:] != self._line.split(": ", 1)[1:]:
            print(line, flush=True)
            self._line = line

    def _await_frames(self) -> float | None:
        """Take the frames that arrive within `POLL_S`. In lockstep, until the client waits.

        Returns:
            In lockstep the longest simulated time to wait, s. None if the client did not ask, so
            that no status answers it.
        """
        while not (self._is_over or self._bus.is_over):
            sockets = [self._listener]
            if self._client is not None and self._pending is None:
                sockets.append(self._client.socket)
            ready = await_sockets(sockets, POLL_S)
            if self._client is not None and self._client.socket in ready:
                self._heard_s = time.monotonic()
                if not self._client.receive():
                    self._take_frames()
                    self._drop_client("the connection is closed")
            # A client that has left makes room for the next one.
            if self._listener in ready:
                self._accept_client()
            timeout_s = self._take_frames()
            if self._child is not None and self._client is None and self._child.poll() is not None:
                raise LevelError("the client has ended without saying how its script ended")
            if (
                timeout_s is not None
                or not self._bus.is_paced
                or self._pending is not None
                or (self._had_client and self._client is None)
            ):
                return timeout_s
        return None

    def _accept_client(self) -> None:
        """Accept a client. Refuse it if there is another one that is not silent."""
        with suppress(OSError):
            new = Connection(self._listener.accept()[0])
            if self._client is not None:
                silent_s = time.monotonic() - self._heard_s
                if silent_s < SILENT_S:
                    self._print(f"client {new.peer}: refused, there is another client")
                    new.send(FrameKind.END, b"the server has another client")
                    new.close()
                    return
                self._drop_client(f"silent for {silent_s:.1f} s, replaced by {new.peer}")
            self._client = new
            self._had_client = True
            self._heard_s = time.monotonic()
            new.send(FrameKind.HELLO, self._build_hello())
            self._send_status(new)

    def _build_hello(self) -> bytes:
        """Return what a client must know of the rack, as JSON."""
        context = self.context
        known = {
            "is_paced": bool(self._bus.is_paced),
            "sent": self.requests.sent,
            "board": context.board,
            "clock_ns": context.clock_ns,
            "robot": context.robot.model_dump(mode="json", by_alias=True),
            "scene": context.scene.model_dump(mode="json", by_alias=True),
            "task": dict(context.task),
            "sizes": dict(context.sizes),
        }
        return encode_json(known).encode()

    def _send_status(self, client: Connection) -> None:
        """Send tick, time and the newest status. A client that is slow to read misses some."""
        if not client.flush():
            return
        reading = self.motion.read()
        head = TICK_AND_TIME.pack(self._bus.tick, self._bus.time_s)
        status = reading.message.record.tobytes() if reading.has_message else b""
        client.send(FrameKind.STATUS, head + status)

    def _take_frames(self) -> float | None:
        """Take received frames up to a WAIT, and return its time-out, s. None without a WAIT."""
        try:
            while self._client is not None:
                frame = self._pending or self._client.take_frame()
                self._pending = None
                if frame is None:
                    return None
                if frame.kind is FrameKind.WAIT and self._bus.is_paced:
                    return _read_timeout(frame.content)
                if frame.kind is FrameKind.END:
                    self._take_end(frame.content.decode(errors="replace"))
                elif frame.kind is not FrameKind.REQUEST:
                    raise FrameError(f"a client must not send {frame.kind.name} now")
                elif not self._send_request(frame.content):
                    self._pending = frame
                    self._print(f"client {self._client.peer}: too many requests, they wait")
                    return None
        except FrameError as error:
            self._drop_client(f"{error}; connection closed")
        return None

    def _send_request(self, content: bytes) -> bool:
        """Pass a request to the bridge. Return False if there is no place for it.

        Raises:
            FrameError: The length is wrong.
        """
        message = self.requests.message
        size = message.record.nbytes
        if len(content) != size:
            raise FrameError(f"a request of {len(content)} bytes; it must have {size}")
        message.raw[:size] = content
        return self.requests.send()

    def _take_end(self, reason: str) -> None:
        """End the program if the client's script has succeeded.

        Raises:
            LevelError: The script that the program has started has failed.
        """
        if not reason:
            self._is_over = True
        elif self._child is None:
            self._drop_client(f"its script failed: {reason[:MAX_REASON]}")
        else:
            raise LevelError(reason)


def _read_timeout(content: bytes) -> float:
    """Return the time-out of a WAIT, s. Raises `FrameError` if it is not a time."""
    timeout_s = TIMEOUT.unpack(content)[0] if len(content) == TIMEOUT.size else -1.0
    if not 0.0 <= timeout_s <= 1e9:
        raise FrameError(f"a wait of {timeout_s:g} s")
    return timeout_s
