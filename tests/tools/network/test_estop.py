"""`rack estop HOST/RACK`: a real rack on loopback, stopped by its address; what a rack leaves
unanswered, and a host that cannot be reached."""

from __future__ import annotations

import json
import os
import signal
import socket
import ssl
import subprocess
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from subprocess import CompletedProcess
from typing import NamedTuple

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.console.address import Operator, RackAddress
from rack.tools.console.answer import Failure
from rack.tools.network.certificates import make_credentials
from rack.tools.network.estop import check_reach
from rack.tools.viewer.window import find_free_port
from tests.boards.commanded_racks import COMMANDED
from tests.processes import BOUND_S, wait_until
from tests.tools.command_line import rack, started
from tests.tools.held_racks import running_rack

pytestmark = pytest.mark.thorough

OF_LAN = """
[adapter.lan]
slot = 5
rate_hz = 100
listen = ["tls/127.0.0.1:{port}"]
certificates = "certs"
peers = ["{peer}"]
estop_from = ["operator"]
"""
STRANGERS = 8


class Far(NamedTuple):
    """A rack that runs: its name here, its address from afar, and the events that its launcher has
    printed."""

    name: str
    address: str
    log: Path

    @property
    def port(self) -> str:
        """HOST:PORT of the address."""
        return self.address.partition("/")[0]


def afar(*commands: str) -> list[CompletedProcess[str]]:
    """Run commands, each as one text in a process of its own, all at once."""
    with ExitStack() as stack:
        processes = [
            stack.enter_context(started(*command.split(), stdin=subprocess.DEVNULL))
            for command in commands
        ]
        texts = [process.communicate(timeout=BOUND_S) for process in processes]
    return [
        CompletedProcess(one.args, one.returncode, *text)
        for one, text in zip(processes, texts, strict=True)
    ]


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Far]:
    """A rack on this machine that runs until it is stopped, to be reached by its address."""
    folder = tmp_path_factory.mktemp("far")
    name, port = f"test-afar-{os.getpid()}", find_free_port()
    peer, config = f"{name}-peer", folder / "far.toml"
    config.write_text(COMMANDED + OF_LAN.format(port=port, peer=peer))
    people = dict.fromkeys((peer, "operator", "nobody"), ())
    make_credentials(folder / "certs", {name: ["127.0.0.1"], **people}, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RACK_CERTIFICATES", str(folder / "certs"))
        with running_rack(config, name, "--set=clock.mode=realtime"):
            yield Far(name, f"127.0.0.1:{port}/{name}", folder / f"{name}.log")


@pytest.fixture
def segment(far: Far) -> Iterator[Segment]:
    """Memory of the rack that runs."""
    with closing(Segment.attach(far.name)) as segment:
        yield segment


@pytest.mark.alone
def test_a_remote_emergency_stop_is_reset_at_the_rack(far: Far, segment: Segment) -> None:
    (stopped,) = afar(f"estop {far.address} --json")
    assert (stopped.returncode, stopped.stderr) == (0, "")
    answer = json.loads(stopped.stdout)
    assert (answer["rack"], answer["emergency_stop"]) == (far.name, True)
    assert segment.words[System.EMERGENCY_STOP] == 1
    wait_until(
        lambda: "'operator' has set the emergency stop from another machine" in far.log.read_text()
    )
    assert rack("estop", far.name, "--reset").returncode == 0
    assert segment.words[System.EMERGENCY_STOP] == 0


@pytest.mark.alone
def test_nobody_can_stop_a_rack_without_a_right_or_a_terminal(far: Far, segment: Segment) -> None:
    nobody = f"no rack '{far.name}' at {far.port}; racks there: none that knows 'nobody'; "
    where = "--ready only stops a rack on another machine, HOST/RACK"
    peer = f"{far.name}-peer"
    reset = f"rack '{far.name}' can only be reset on its own machine"
    refused = {
        f"estop {far.address} --as nobody": (
            1,
            f"{nobody}its certificate and yours must be of one authority",
        ),
        f"estop {far.port}/other": (1, f"no rack 'other' at {far.port}; racks there: {far.name}"),
        f"estop {far.address} --as {peer}": (
            1,
            f"rack '{far.name}' does not permit '{peer}' to stop it;"
            " name it in adapter.lan.estop_from of the rack's config",
        ),
        f"estop {far.address} --reset": (1, f"{reset}: rack estop {far.name} --reset"),
        f"estop {far.address} --ready": (1, "stdin has ended before a stop was set"),
        f"estop {far.name} --ready": (2, f"--ready, {far.name}: {where}"),
        f"estop {far.address} --ready --reset": (2, f"--ready, --reset: {where}"),
        f"status {far.address}": (
            2,
            f"RACK = {far.address}: run this command on the rack's machine, as in:"
            " ssh HOST rack status; only 'rack estop' works from another machine",
        ),
    }
    ended = afar(*refused)
    found = [(one.returncode, one.stderr.splitlines()[-1]) for one in ended]
    assert found == [*refused.values()]
    assert segment.words[System.EMERGENCY_STOP] == 0


@contextmanager
def shaking_hands(port: int) -> Iterator[Callable[[], int]]:
    """Let strangers without a certificate connect again and again; yield how often they have."""
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    ended = threading.Event()
    made: list[None] = []

    def shake() -> None:
        while not ended.is_set():
            with (
                suppress(OSError),
                socket.create_connection(("127.0.0.1", port), 3.0) as connection,
                context.wrap_socket(connection) as refused,
            ):
                refused.recv(1)
            made.append(None)

    with ThreadPoolExecutor(STRANGERS) as pool:
        for _ in range(STRANGERS):
            pool.submit(shake)
        try:
            yield lambda: len(made)
        finally:
            ended.set()


@pytest.mark.alone
def test_a_stop_that_is_ready_waits_for_no_handshake_of_strangers(
    far: Far, segment: Segment
) -> None:
    port = int(far.port.rpartition(":")[2])
    with started("estop", far.address, "--ready", "--json") as ready, shaking_hands(port) as made:
        assert ready.stdin is not None
        assert ready.stderr is not None
        assert ready.stderr.readline() == f"ready to stop rack '{far.address}'\n"
        before = made()
        wait_until(lambda: made() > before + STRANGERS)
        assert segment.words[System.EMERGENCY_STOP] == 0
        ready.stdin.write("\n")
        ready.stdin.flush()
        out, err = ready.communicate(timeout=BOUND_S)
        assert (ready.returncode, err) == (0, "")
        assert json.loads(out)["emergency_stop"] is True
        assert segment.words[System.EMERGENCY_STOP] == 1
        # They are still at it.
        before = made()
        wait_until(lambda: made() > before)
    assert rack("estop", far.name, "--reset").returncode == 0


@pytest.mark.alone
def test_a_ready_operator_is_told_when_the_run_ends(far: Far) -> None:
    with started("estop", far.address, "--ready") as ready:
        assert ready.stderr is not None
        assert ready.stderr.readline().startswith("ready to stop")
        assert rack("stop", far.name).returncode == 0
        assert ready.stderr.readline().startswith(f"not ready: no rack '{far.name}' at {far.port}")
        ready.send_signal(signal.SIGINT)
        assert ready.wait(BOUND_S) == 128 + signal.SIGINT


def test_an_unreachable_host_is_reported_in_one_line(tmp_path: Path) -> None:
    port = find_free_port()
    make_credentials(tmp_path / "certs", {"cell": []}, 1)
    why = "must be RACK or HOST[:PORT]/RACK, as in 10.0.0.5/cell"
    with socket.create_server(("127.0.0.1", 0)) as server:
        open_port = server.getsockname()[1]
        ended = afar(
            f"estop 127.0.0.1:{port}/x",
            "estop 127.0.0.1:99999/x",
            "estop 127.0.0.1/X!",
            "estop 127.0.0.1/x --as X!",
            f"estop 127.0.0.1:{open_port}/x --certificates {tmp_path}/certs --as stranger",
        )
    missing = (
        f"{tmp_path}/certs/stranger.pem: the file is missing; see rack lan certificates --help"
    )
    assert [one.stderr.strip() for one in ended] == [
        f"127.0.0.1:{port}: cannot connect to port {port}: Connection refused",
        f'RACK = "127.0.0.1:99999/x": {why}',
        f'RACK = "127.0.0.1/X!": {why}',
        '--as = "X!": must be at most 40 small letters, digits, "-" and "_"',
        missing,
    ]


def test_no_request_is_sent_to_another_machine_without_certificates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(socket.socket, "getpeername", lambda self: ("192.0.2.7", 7447))
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        pytest.raises(Failure, match="is another machine, so a stop needs certificates"),
    ):
        check_reach(RackAddress("127.0.0.1", server.getsockname()[1], "cell"), Operator())
