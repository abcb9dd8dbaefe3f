"""The link as a process: what it opens, and what it bears. Real sessions."""

from __future__ import annotations

import json
import socket
import stat
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from rack.boards.lan.config import LanTable
from rack.boards.lan.keys import out_key
from rack.boards.lan.link import LanLink
from rack.levels.errors import LevelError
from rack.tools.viewer.window import find_free_port
from tests.boards.lan.test_strangers import OWN, Program, Site, at_home, friend, running
from tests.processes import wait_until

pytestmark = pytest.mark.slow

LISTENS = "0A"
"""State of a listening socket in /proc/net/tcp."""
ZENOH_WAITS_S = 0.5
"""Its `scouting/delay`."""
PULSE = out_key("friend", "pulse.status")


def sockets(pid: int) -> Iterator[tuple[str, str]]:
    """Yield protocol and state of each socket of a process."""
    own = set()
    for fd in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):
            own.add(str(fd.readlink()))
    for protocol in ("tcp", "tcp6", "udp", "udp6", "raw", "raw6"):
        for line in Path(f"/proc/{pid}/net/{protocol}").read_text().splitlines()[1:]:
            state, inode = line.split()[3], line.split()[9]
            if f"socket:[{inode}]" in own:
                yield protocol, state


@contextmanager
def home(**table: Any) -> Iterator[Program]:
    """Run a link until the end of the block."""
    with running("home", "home", json.dumps(table)) as program:
        yield program


@pytest.mark.parametrize("listens", [False, True])
def test_it_listens_only_where_the_config_says_and_sends_no_datagram(listens: bool) -> None:
    end = f"tcp/127.0.0.1:{find_free_port()}"
    with home(peers=["friend"], listen=[end] * listens) as program:
        assert program.state()["came"] == {}
        assert list(sockets(program.pid)) == [("tcp", LISTENS)] * listens


def test_a_unix_socket_is_reached_by_its_own_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with home(listen=["unix/cell"]), home(connect=["unix/cell"]) as program:
        wait_until(lambda: program.state()["connected"])
        assert list(sockets(program.pid)) == []
    (folder,) = tmp_path.iterdir()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for mode in (0o710, 0o702):
        folder.chmod(mode)
        with pytest.raises(LevelError, match="others can access it"):
            LanLink("cell", LanTable(listen=("unix/cell",)))


def test_opening_waits_for_no_peer() -> None:
    """A restarted board would come back late: zenoh by itself waits for a peer that is not
    there."""

    def opened_s() -> float:
        with home(connect=[f"tcp/127.0.0.1:{find_free_port()}"]) as program:
            return float(program.state()["opened_s"])

    assert any(opened_s() < ZENOH_WAITS_S for _ in range(3))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with at_home(tmp_path_factory.mktemp("site")) as site:
        yield site


def crowd(site: Site, stack: ExitStack) -> None:
    """Open connections that say nothing, and let as many fail their handshake."""
    for _ in range(100):
        stack.enter_context(socket.create_connection(("127.0.0.1", site.port)))
        with socket.create_connection(("127.0.0.1", site.port)) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n" + bytes(1000))


def test_failing_handshakes_do_not_disturb_connected_racks(site: Site) -> None:
    with ExitStack() as stack, running("strangers", json.dumps({"friend": friend(site)})) as others:
        wait_until(lambda: others.state()["friend"]["heard"])
        wait_until(lambda: "friend came" in site.home.state()["tokens"])
        wait_until(lambda: site.home.state()["good"].get(PULSE))
        before = site.home.state()["tokens"]
        crowd(site, stack)
        good, heard = site.home.state()["good"][PULSE], others.state()["friend"]["heard"][OWN]
        wait_until(lambda: site.home.state()["good"][PULSE] > good + 10)
        wait_until(lambda: others.state()["friend"]["heard"][OWN] > heard + 10)
        assert site.home.state()["tokens"] == before


def test_during_failing_handshakes_a_rack_can_connect_outwards(site: Site) -> None:
    """The door itself opens late: zenoh takes no connection for 0.1 s after each failed
    handshake."""
    listening = {f"{way}/endpoints": [] for way in ("listen", "connect")}
    listening["listen/endpoints"] = [f"tls/127.0.0.1:{site.friends_port}"]
    outside = friend(site)
    outside["settings"] |= listening
    with ExitStack() as stack:
        crowd(site, stack)
        before = site.home.state()
        came, good = before["tokens"].count("friend came"), before["good"].get(PULSE, 0)
        others = stack.enter_context(running("strangers", json.dumps({"friend": outside})))
        wait_until(lambda: others.state()["friend"]["heard"])
        wait_until(lambda: site.home.state()["good"].get(PULSE, 0) > good + 10)
        assert site.home.state()["tokens"].count("friend came") > came
