"""A client of the force and motion server over TCP: frames, lockstep, clients that misbehave."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.levels.errors import LevelError
from rack.levels.systems.force.frames import HEAD, MAGIC, FrameKind
from rack.levels.systems.force.messages import ServerRequest
from rack.levels.systems.force.network_client import RemoteServer, main, run_client
from rack.levels.systems.force.network_server import SILENT_S, NetworkServer
from rack.levels.systems.trajectory.messages import MotionKind
from rack.tools.viewer.window import find_free_port
from tests.levels.systems.force.test_client import CONTEXT, Bus
from tests.processes import BOUND_S, in_thread, wait_until

HOST = "127.0.0.1"
SCRIPT = """
request = comply("wipe")
wait(request)
assert where() == [0.5, 0.25, 0.125], where()
print(bus.tick)
"""
"""It waits until the rack's side reports its request as done."""


class RackSide(Bus):
    """Bus and ports of the program that serves clients: ticks pass as it waits."""

    def __init__(self, is_paced: bool, places: int = 1000) -> None:
        super().__init__()
        self.is_paced = is_paced
        self.places = places  # of the ring
        self.waits: list[float] = []
        self.status.place = (0.5, 0.25, 0.125)

    def wait(self, timeout_s: float) -> bool:
        self.waits.append(timeout_s)
        self.status.done = max([request.id for request in self.requests], default=0)
        return super().wait(timeout_s)

    def send(self) -> bool:
        if len(self.requests) >= self.places:
            return False
        self.sent += 1
        return super().send()


class Served:
    """A program that serves clients in a thread, until the test ends."""

    def __init__(self, side: RackSide, **params: Any) -> None:
        self.side = side
        self.address = HOST, find_free_port()
        listen = f"{HOST}:{self.address[1]}"
        program = NetworkServer(replace(CONTEXT, params={"listen": listen, **params}))
        vars(program).update(motion=side, requests=side)
        self._program = program
        self.error = ""
        self.is_done = False

    def run(self) -> None:
        try:
            self._program.run(self.side)  # type: ignore[arg-type]
        except LevelError as error:
            self.error = str(error)
        self.is_done = True

    def connect(self) -> socket.socket:
        """Connect as soon as the server listens."""
        found: list[socket.socket] = []

        def is_connected() -> bool:
            with suppress(ConnectionRefusedError):
                found.append(socket.create_connection(self.address, 5.0))
            return bool(found)

        wait_until(is_connected)
        return found[0]


@contextmanager
def serving(side: RackSide, **params: Any) -> Iterator[Served]:
    served = Served(side, **params)
    with in_thread(served.run):
        try:
            yield served
        finally:
            side.is_over = True


@pytest.fixture
def script(tmp_path: Path) -> str:
    file = tmp_path / "script.py"
    file.write_text(SCRIPT)
    return str(file)


@pytest.mark.parametrize("is_paced", [False, True])
def test_a_script_in_a_client_process_commands_as_on_a_host_board(
    is_paced: bool, script: str, capfd: pytest.CaptureFixture[str]
) -> None:
    side = RackSide(is_paced)
    with serving(side, script=script) as served:
        wait_until(lambda: served.is_done)
    assert served.error == ""
    comply = side.requests[0]
    assert (comply.kind, comply.id) == (MotionKind.COMPLY, 1)
    assert comply.wrench.tolist() == [0, 0, 15, 0, 0, 0]
    assert np.allclose(comply.frame, (0.0, 0.70710678, 0.70710678, 0.0))
    if is_paced:
        # The rack's time stands still except in the waits of the client.
        assert (side.waits, capfd.readouterr().out) == ([0.25], "20\n")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("raise RuntimeError('no force')", "RuntimeError: no force (script.py, line 1)"),
        ("import os; os._exit(3)", "the client has ended without saying how its script ended"),
    ],
)
def test_a_failed_script_fails_the_host_board(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "script.py").write_text(text)
    with serving(RackSide(False), script=str(tmp_path / "script.py")) as served:
        wait_until(lambda: served.is_done)
    assert served.error == reason


def frame(kind: int, content: bytes = b"") -> bytes:
    return HEAD.pack(MAGIC, kind, len(content)) + content


@pytest.mark.parametrize(
    ("sent", "line"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", "b'GET / HTT' does not begin a frame; connection closed"),
        (frame(9), r"b'RFM1\t\x00\x00\x00\x00' does not begin a frame; connection closed"),
        (MAGIC + bytes([3]) + b"\xff" * 4, "does not begin a frame; connection closed"),
        (frame(FrameKind.REQUEST, b"x" * 7), "a request of 7 bytes; it must have"),
        (frame(FrameKind.WAIT, b"x" * 8), "a client must not send WAIT now; connection closed"),
        (frame(FrameKind.HELLO), "a client must not send HELLO now; connection closed"),
        (frame(FrameKind.END, b"no block"), "its script failed: no block"),
        (b"", "the connection is closed"),
    ],
)
def test_garbage_costs_its_sender_the_connection(
    sent: bytes, line: str, script: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with serving(RackSide(False)) as served:
        for _ in range(3):
            with served.connect() as stranger:
                stranger.sendall(sent)
                stranger.shutdown(socket.SHUT_WR)
                with suppress(ConnectionError):
                    while stranger.recv(1 << 16):
                        pass
        run_client(served.address, script)
        wait_until(lambda: served.is_done)
    lines = capfd.readouterr().out.splitlines()
    # Repeated lines are left out.
    assert [line in text for text in lines] == [False, True, False]
    assert lines[0] == f"clients connect to {HOST}:{served.address[1]}"


def test_a_flood_waits_and_is_reported_once(capfd: pytest.CaptureFixture[str]) -> None:
    side = RackSide(False, places=5)
    with serving(side) as served, served.connect() as flooding:
        flooding.settimeout(0.2)
        request = frame(FrameKind.REQUEST, ServerRequest.zeros(CONTEXT.sizes).record.tobytes())
        with suppress(TimeoutError):
            for _ in range(1000):
                flooding.sendall(100 * request)
            pytest.fail("the server takes all requests")
        # A slow machine takes the first ones after the flood.
        wait_until(lambda: len(side.requests) == 5)
        # The rack is served meanwhile, and what waits is taken in order.
        waits = len(side.waits)
        side.places = 8
        wait_until(lambda: len(side.requests) == 8 and len(side.waits) > waits)
    assert capfd.readouterr().out.count("too many requests, they wait") == 1


def test_a_second_client_is_refused_until_the_first_is_silent(
    script: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with serving(RackSide(False)) as served, served.connect() as first:
        first.recv(1)
        # On a slow machine the second one may come late.
        silent_s = "rack.levels.systems.force.network_server.SILENT_S"
        monkeypatch.setattr(silent_s, BOUND_S)
        with pytest.raises(LevelError, match="the server has another client"):
            run_client(served.address, script)
        monkeypatch.setattr(silent_s, 0.0)
        run_client(served.address, script)
        wait_until(lambda: served.is_done)
    out = capfd.readouterr().out
    assert "refused, there is another client" in out
    assert "replaced by" in out
    assert SILENT_S > 0.0


def test_a_client_ends_with_the_run_and_reports_a_lost_server(script: str) -> None:
    side = RackSide(False)
    with serving(side) as served:
        served.connect().close()
        remote = RemoteServer(served.address, script)
        side.is_over = True
        wait_until(lambda: not remote.wait(0.1) and remote.is_over)
        remote.finish()
    with serving(RackSide(True)) as served:
        served.connect().close()
        remote = RemoteServer(served.address, script)
        with pytest.raises(LevelError, match="has closed the connection"):
            remote.wait(-1.0)


@pytest.mark.parametrize(
    ("arguments", "status", "line"),
    [
        (["127.0.0.1:1", "x.py"], 1, "no server at 127.0.0.1:1: Connection refused"),
        (["nowhere", "x.py"], 2, "must be an IPv4 address and a port, as in 127.0.0.1:7260"),
        (["127.0.0.1:65536", "x.py"], 2, "must be an IPv4 address and a port"),
        (["127.0.0.1:7260"], 2, "usage: "),
    ],
)
def test_mistakes_of_the_command_are_one_line(
    arguments: list[str], status: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == status
    printed = capsys.readouterr().err
    assert line in printed
    assert printed.count("\n") == 1
