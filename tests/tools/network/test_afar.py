"""Commands on HOST/RACK: a real rack on loopback, looked at, commanded and stopped by its
address."""

from __future__ import annotations

import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rack.backplane.operator_table import OperatorTable
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.tools.network.certificates import make_credentials
from rack.tools.scripting.attached import AttachedRack
from rack.tools.viewer.window import free_port
from tests.boards.commanded_racks import COMMANDED
from tests.processes import BOUND_S, RACK, wait_until
from tests.tools.command_line import ROOT, rack

pytestmark = pytest.mark.thorough

OF_LAN = """
[adapter.lan]
slot = 5
rate_hz = 100
listen = ["tls/127.0.0.1:{port}"]
certificates = "certs"
peers = ["{peer}"]

[adapter.lan.permit]
operator = ["watch", "command", "stop"]
watcher = ["watch"]
"""
STRANGERS = 8
LATE = str(10**9)
"""A tick that no test reaches."""
NOT_PERMITTED = "rack '{}' does not permit '{}' to {}; its config: adapter.lan.permit"


class Far(NamedTuple):
    """A rack that runs: its name here, its address from afar, the events that its launcher has
    printed, and the rack that it works with, with where that is."""

    name: str
    address: str
    log: Path
    peer: list[str]

    @property
    def port(self) -> str:
        """HOST:PORT of the address."""
        return self.address.partition("/")[0]


class Ended(NamedTuple):
    """How a command ended."""

    status: int
    out: str
    err: str


def afar(*commands: str) -> list[Ended]:
    """Run commands, each as one text, in a client's process."""
    words = [json.dumps(command.split()) for command in commands]
    client = subprocess.run(
        [sys.executable, "-m", "tests.tools.network.client", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=BOUND_S * 2,
    )
    assert client.returncode == 0, client.stderr
    return [Ended(*ended) for ended in json.loads(client.stdout)]


def started(folder: Path, mode: str) -> Iterator[Far]:
    """Start a rack that runs until it is stopped, and stop it at the end."""
    name, port = f"test-afar-{mode}-{os.getpid()}", free_port()
    peer = f"{name}-peer"
    config, log = folder / "far.toml", folder / "log"
    config.write_text(COMMANDED + OF_LAN.format(port=port, peer=peer))
    people = dict.fromkeys((peer, "operator", "watcher", "nobody"), ())
    make_credentials(folder / "certs", {name: ["127.0.0.1"], **people}, 1)
    given = [
        word for setting in (f"name={name}", f"clock.mode={mode}") for word in ("--set", setting)
    ]
    with log.open("w") as out, ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        patch.setenv("RACK_CERTIFICATES", str(folder / "certs"))
        process = subprocess.Popen(
            [*RACK, "run", str(config), "--no-record", *given], cwd=ROOT, stdout=out, stderr=out
        )
        try:
            if is_lockstep := mode == "lockstep":
                # It steps with its peer, and waits for that.
                stack.enter_context(partner(config, peer, name, port))
            wait_until(lambda: f"{name} " in log.read_text() or process.poll() is not None)
            assert process.poll() is None, log.read_text()
            seen = [peer, "there" if is_lockstep else "awaited"]
            yield Far(name, f"127.0.0.1:{port}/{name}", log, seen)
        finally:
            rack("stop", name)
            process.kill()
            process.communicate()


@contextmanager
def partner(config: Path, name: str, other: str, port: int) -> Iterator[None]:
    """Run a rack that steps with the other one."""
    lan = (f'connect=["tls/127.0.0.1:{port}"]', "listen=[]", f'peers=["{other}"]')
    settings = (f"name={name}", *(f"adapter.lan.{setting}" for setting in lan))
    given = [word for setting in settings for word in ("--set", setting)]
    with client("run", str(config), "--lockstep", "--no-record", *given):
        try:
            yield
        finally:
            rack("stop", name)


@contextmanager
def client(*words: str) -> Iterator[subprocess.Popen[str]]:
    """Run a command in a process of its own, which is killed at the end, should it still run."""
    pipe = subprocess.PIPE
    is_ready = "--ready" in words
    process = subprocess.Popen(
        [*RACK, *words],
        cwd=ROOT,
        stdin=pipe if is_ready else None,
        stdout=pipe,
        stderr=pipe if is_ready else None,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


IN_REAL_TIME = pytest.param("realtime", marks=pytest.mark.alone)
"""Next to racks in real time of other tests the one asked falls silent, and counts as gone."""
REALTIME = pytest.mark.parametrize("far", [IN_REAL_TIME], indirect=True)
IN_BOTH = pytest.mark.parametrize("far", [IN_REAL_TIME, "lockstep"], indirect=True)


@pytest.fixture(scope="module")
def far(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Far]:
    """A rack on this machine, to be reached by its address."""
    yield from started(tmp_path_factory.mktemp("far"), request.param)


def shape(document: Any) -> Any:
    """Return what is not a number in a document: its keys, its texts, its lists' lengths."""
    if isinstance(document, Mapping):
        return {key: shape(value) for key, value in document.items()}
    if isinstance(document, list):
        return [shape(item) for item in document]
    return (
        "number"
        if isinstance(document, float | int) and not isinstance(document, bool)
        else document
    )


@pytest.mark.slow
@IN_BOTH
def test_a_status_from_afar_has_the_fields_of_the_local_one(far: Far) -> None:
    near = json.loads(rack("status", far.name, "--json").stdout)
    (seen,) = afar(f"status {far.address} --json")
    assert seen.status == 0, seen.err
    document = json.loads(seen.out)
    assert shape(document) == shape(near)
    assert document["tick"] > near["tick"]
    assert all(
        row["cycles"] > before["cycles"]
        for row, before in zip(document["tasks"], near["tasks"], strict=True)
    )


@pytest.mark.slow
@IN_BOTH
def test_a_command_is_given_taken_up_and_resumed(far: Far) -> None:
    held, listed, resumed, wrong = afar(
        f"command {far.address} upper hold --wait --json",
        f"command {far.address} --list",
        f"command {far.address} upper resume",
        f"command {far.address} upper jump",
    )
    answer = json.loads(held.out)
    assert (held.status, answer["level"], answer["fate"]) == (0, "upper", "done")
    assert answer["given"] < answer["taken_up"] < answer["done"]
    assert "upper  hold " in listed.out
    assert (resumed.status, "taken up at tick" in resumed.out) == (0, True)
    assert wrong.status == 2
    assert wrong.err.startswith('what = "jump": ')


@pytest.mark.slow
@REALTIME
def test_nobody_does_what_the_config_does_not_permit(far: Far) -> None:
    ended = afar(
        f"command {far.address} upper hold --as watcher",
        f"estop {far.address} --as watcher",
        f"status {far.address} --as nobody",
        f"status {far.port}/other",
        f"estop {far.address} --reset",
        f"stop {far.address}",
    )
    assert [one.err.strip() for one in ended] == [
        NOT_PERMITTED.format(far.name, "watcher", "command"),
        NOT_PERMITTED.format(far.name, "watcher", "stop"),
        f"no rack '{far.name}' at {far.port}; racks there: none that knows 'nobody'",
        f"no rack 'other' at {far.port}; racks there: {far.name}",
        (
            f"rack '{far.name}' resets an emergency stop on its own machine alone: rack estop"
            f" {far.name} --reset"
        ),
        (
            f"RACK = {far.address}: this command works on the rack's own machine alone; permitted"
            " from afar: list --lan, status, top, command, estop"
        ),
    ]
    assert [one.status for one in ended] == [1, 1, 1, 1, 1, 2]


@pytest.mark.slow
@IN_BOTH
def test_the_racks_at_a_host_are_listed_with_the_peers_that_they_await(far: Far) -> None:
    shown, closed = afar(
        f"list --lan {far.port} --json", f"list --lan {far.port} --as nobody --json"
    )
    found = next(row for row in json.loads(shown.out) if row["host"] == far.port)
    assert (found["rack"], found["state"], found["peers"]) == (
        far.name,
        "running",
        [far.peer],
    )
    assert found["age_s"] > 0
    hidden = next(row for row in json.loads(closed.out) if row["host"] == far.port)
    assert hidden["detail"] == f"{far.port}: racks there: none that knows 'nobody'"


@pytest.mark.slow
@REALTIME
def test_an_emergency_stop_is_set_from_afar_and_reset_at_the_rack(far: Far) -> None:
    segment = Segment.attach(far.name)
    stopped, seen = afar(f"estop {far.address} --json", f"status {far.address}")
    assert stopped.status == 0, stopped.err
    assert json.loads(stopped.out)["emergency_stop"] is True
    assert segment.words[System.EMERGENCY_STOP] == 1
    assert f"to release: rack estop {far.name} --reset, on its own machine" in " ".join(
        seen.out.split()
    )
    wait_until(
        lambda: "'operator' has set the emergency stop from another machine" in far.log.read_text()
    )
    assert rack("estop", far.name, "--reset").returncode == 0
    assert segment.words[System.EMERGENCY_STOP] == 0
    segment.close()


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


@pytest.mark.slow
@REALTIME
def test_a_stop_that_is_ready_waits_for_no_handshake_of_strangers(far: Far) -> None:
    segment = Segment.attach(far.name)
    port = int(far.port.rpartition(":")[2])
    with client("estop", far.address, "--ready", "--json") as ready, shaking_hands(port) as made:
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
    segment.close()


@pytest.mark.slow
@REALTIME
def test_nobody_is_ready_to_stop_who_may_not_or_has_no_key_to_press(far: Far) -> None:
    ended = afar(
        f"estop {far.address} --ready --as watcher",
        f"estop {far.address} --ready",
        f"estop {far.name} --ready",
        f"estop {far.address} --ready --reset",
    )
    where = "it waits to stop a rack of another machine, HOST/RACK"
    assert [(one.status, one.err.splitlines()) for one in ended] == [
        (1, [NOT_PERMITTED.format(far.name, "watcher", "stop")]),
        (1, [f"ready to stop rack '{far.address}'", "stdin has ended, and no stop was set"]),
        (2, [f"--ready, {far.name}: {where}"]),
        (2, [f"--ready, --reset: {where}"]),
    ]
    segment = Segment.attach(far.name)
    assert segment.words[System.EMERGENCY_STOP] == 0
    segment.close()


@pytest.mark.slow
@REALTIME
def test_a_client_that_is_interrupted_leaves_nothing_behind(far: Far) -> None:
    segment = Segment.attach(far.name)
    table = OperatorTable(segment)
    with (
        client("top", far.address) as top,
        client("command", far.address, "upper", "hold", "--tick", LATE) as command,
    ):
        assert top.stdout is not None
        assert top.stdout.readline().startswith(far.name)
        wait_until(table.waiting)
        for process in (top, command):
            process.send_signal(signal.SIGINT)
        assert [process.wait(BOUND_S) for process in (top, command)] == [128 + signal.SIGINT] * 2
        # At once, or, if it did not know its ticket yet, when it has not been heard of for a while.
        wait_until(lambda: not table.waiting())
    segment.close()


@pytest.mark.slow
@REALTIME
@pytest.mark.parametrize("gone", [signal.SIGKILL, signal.SIGSTOP, signal.SIGINT])
def test_a_level_holds_whose_operator_afar_has_gone_within_a_lease(
    far: Far, gone: signal.Signals
) -> None:
    with (
        AttachedRack(far.name) as live,
        client("command", far.address, "upper", "hold", "--lease") as command,
    ):
        assert command.stdout is not None
        assert command.stdout.readline().startswith("command ")
        command.send_signal(gone)
        event = live.wait_for("operator_gone", BOUND_S)
        assert (event.board, event.text[:27]) == ("upper", "hold: its operator is gone:")
    assert rack("command", far.name, "upper", "resume").returncode == 0


@pytest.mark.slow
@REALTIME
def test_a_lease_from_afar_ends_with_a_newer_command_and_when_it_is_refused(far: Far) -> None:
    (refused,) = afar(f"command {far.address} upper goto home --lease")
    assert (refused.status, "the way home is closed" in refused.out) == (1, True)
    with client("command", far.address, "upper", "hold", "--lease") as command:
        assert command.stdout is not None
        assert command.stdout.readline().startswith("command ")
        assert rack("command", far.name, "upper", "resume").returncode == 0
        assert command.wait(BOUND_S) == 0
    segment = Segment.attach(far.name)
    assert not OperatorTable(segment).leased()
    segment.close()
    (status,) = afar(f"status {far.address} --json")
    assert {row["task"]: row["mode"] for row in json.loads(status.out)["tasks"]}["upper"] == (
        "automatic"
    )


@pytest.mark.slow
@REALTIME
def test_who_watches_sees_the_run_stop(far: Far) -> None:
    with client("top", far.address) as top, client("estop", far.address, "--ready") as ready:
        assert top.stdout is not None
        assert ready.stderr is not None
        assert ready.stderr.readline().startswith("ready to stop")
        assert "running" not in top.stdout.readline()
        assert rack("stop", far.name).returncode == 0
        assert top.wait(BOUND_S) == 0
        assert "gone" not in top.stdout.read()
        assert ready.stderr.readline().startswith(f"not ready: no rack '{far.name}' at {far.port}")
        ready.send_signal(signal.SIGINT)
        assert ready.wait(BOUND_S) == 128 + signal.SIGINT


@pytest.mark.slow
def test_a_host_that_cannot_be_reached_is_one_line() -> None:
    port = free_port()
    ended = afar(
        f"status 127.0.0.1:{port}/x",
        "status 127.0.0.1:99999/x",
        "status 127.0.0.1/X!",
        "list localhost",
    )
    assert [one.err.strip() for one in ended] == [
        f"127.0.0.1:{port}: cannot connect to port {port}: Connection refused",
        (
            'HOST = "127.0.0.1:99999": not a host; permitted: a name or address, as in 10.0.0.5 or'
            " cell:7447"
        ),
        'RACK = "127.0.0.1/X!": not a rack; permitted: RACK, or HOST/RACK, as in 10.0.0.5/cell',
        "HOST = localhost: needs --lan, as in: rack list --lan localhost",
    ]
