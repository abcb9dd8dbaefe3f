"""Strangers on the network: a rack over TLS, and sessions that are not what they should be, in
other processes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import MAX_MESSAGE_BYTES
from rack.boards.lan.keys import out_key
from rack.tools.network.certificates import make_credentials
from rack.tools.viewer.window import find_free_port
from tests.processes import BOUND_S, wait_until

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
IMPORTED = (
    "friend/pulse.status",
    "liar/pulse.status",
    "liar/second.status",
    "mole/pulse.status",
    "heavy/pulse.status",
)
NAMES = ("friend", "liar", "mole", "heavy", "viewer", "nobody")
OWN, TOKEN = "rack/home/out/pulse/status", "rack/home/alive/0000000000000007"
STOP, STRANGER = "rack/viewer/estop/home", "rack/nobody/estop/home"
FRIENDS_STOP = "rack/friend/estop/home"
ROUNDS = 10
"""Rounds of sending after everyone who may connect has."""


def pulse(name: str) -> str:
    return out_key(name, "pulse.status")


class Program:
    """A program that answers each line with one of JSON."""

    def __init__(self, module: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"tests.boards.lan.{module}", *arguments]
        self._process = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.pid = self._process.pid

    def state(self) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return dict(json.loads(self._process.stdout.readline()))

    def end(self) -> None:
        """End it: by the end of its stdin, if it still listens to that."""
        try:
            self._process.communicate(timeout=BOUND_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
            raise


@contextmanager
def running(module: str, *arguments: str) -> Iterator[Program]:
    program = Program(module, *arguments)
    try:
        yield program
    finally:
        program.end()


@dataclass(frozen=True)
class Site:
    """A rack at home, its credentials, and the port on which it looks for friend."""

    folder: Path
    port: int
    friends_port: int
    home: Program

    def mutual(self, name: str, folder: str = "set") -> dict[str, Any]:
        """Return settings of a session that shows the certificate of a name."""
        own = Credentials(self.folder / folder, name)
        files = {"certificate": str(own.certificate), "private_key": str(own.key)}
        shown = {
            f"{side}_{key}": file for side in ("connect", "listen") for key, file in files.items()
        }
        return self._over("tls", {"enable_mtls": True, **shown})

    def bare(self, protocol: str) -> dict[str, Any]:
        """Return settings of a session without a certificate."""
        return self._over(protocol, {})

    def seals(self, name: str, folder: str = "set") -> tuple[str, str]:
        return str(self.folder / folder), name

    def _over(self, protocol: str, tls: dict[str, Any]) -> dict[str, Any]:
        tls = {"root_ca_certificate": str(self.folder / "set/authority.pem"), **tls}
        return {
            "connect/endpoints": [f"{protocol}/127.0.0.1:{self.port}"],
            "transport/link/tls": tls,
        }


@contextmanager
def at_home(folder: Path, protocol: str = "tls") -> Iterator[Site]:
    """Run a rack that imports from friend, liar, mole and heavy; viewer and friend may stop it."""
    for each in ("set", "forged"):
        addresses = {name: ["127.0.0.1"] for name in ("home", *NAMES)}
        make_credentials(folder / each, {**addresses, "impostor": ["127.9.9.9"]}, 1)
    port, friends_port = find_free_port(), find_free_port()
    entry = {"type": "lan_levels:PulseStatus", "max_age_ms": 100.0}
    table = {
        "listen": [f"{protocol}/127.0.0.1:{port}"],
        # Over quic zenoh does one handshake at a time, and that to nobody takes 3 s.
        "connect": [] if protocol == "quic" else [f"{protocol}/127.0.0.1:{friends_port}"],
        "certificates": str(folder / "set"),
        "estop_from": ["viewer", "friend"],
        "export": {"pulse": {"from": "pulse.status"}},
        "import": {f"port{at}": {"from": source, **entry} for at, source in enumerate(IMPORTED)},
    }
    with running("home", "home", json.dumps(table)) as home:
        yield Site(folder, port, friends_port, home)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with at_home(tmp_path_factory.mktemp("site")) as site:
        yield site


def sealing(site: Site, name: str, **more: Any) -> dict[str, Any]:
    """Return a session with certificate and seals of a name."""
    return {"settings": site.mutual(name), "seals": site.seals(name), **more}


def friend(site: Site) -> dict[str, Any]:
    """Return the session of a rack that does nothing wrong."""
    puts, token = [(pulse("friend"), 100, pulse("friend"))], "rack/friend/alive/0000000000000009"
    return sealing(site, "friend", puts=puts, listens=[OWN], asks=[FRIENDS_STOP], token=token)


def sessions(site: Site) -> dict[str, dict[str, Any]]:
    """Return a friend's session and those of strangers."""
    # Even with a seal of the one in whose name they come.
    puts = [(pulse("friend"), 99, pulse("friend"))]
    eager = {"seals": site.seals("friend"), "puts": puts, "listens": ["**", OWN]}
    eager["asks"] = [STRANGER]
    own = [(pulse(name), 99, pulse(name)) for name in ("nobody", "viewer", "home")]
    liar, second = pulse("liar"), out_key("liar", "second.status")
    lies = [(liar, 100, None), (liar, MAX_MESSAGE_BYTES + 1, liar), (second, 100, liar)]
    heavy = [(pulse("heavy"), size, pulse("heavy")) for size in (100, 1 << 20)]
    impostor = site.mutual("impostor") | {"connect/endpoints": []}
    impostor["listen/endpoints"] = [f"tls/127.0.0.1:{site.friends_port}"]
    asks = [STOP, FRIENDS_STOP, "rack/*/estop/home", "rack/viewer/estop/other"]
    nobody = {**eager, "settings": site.mutual("nobody"), "puts": [*puts, *own]}
    mole = [(pulse("mole"), 9, pulse("mole"))]
    return {
        "friend": friend(site),
        "bare": {"settings": site.bare("tls"), "fails": True, **eager},
        "plain": {"settings": site.bare("tcp"), "fails": True, **eager},
        "forged": {"settings": site.mutual("friend", "forged"), "fails": True, **eager},
        "nobody": nobody,
        "viewer": {**nobody, "settings": site.mutual("viewer"), "asks": asks},
        "liar": sealing(site, "liar", puts=[*lies, *puts, *own, (liar, 100, liar)]),
        "mole": sealing(site, "mole", puts=mole) | {"seals": site.seals("mole", "forged")},
        "heavy": sealing(site, "heavy", puts=heavy),
        "impostor": {"settings": impostor, **eager},
    }


class Found(NamedTuple):
    """What home and each session have got in the end."""

    home: dict[str, Any]
    of: dict[str, Any]


@pytest.fixture(scope="module")
def found(site: Site) -> Found:
    """What everyone has got after each who may connect has sent for some rounds."""
    with running("strangers", json.dumps(sessions(site))) as others:

        def everyone_has_acted() -> bool:
            home, of = site.home.state(), others.state()
            senders = (pulse(name) for name in ("friend", "liar", "mole", "heavy"))
            return (
                all(home["came"].get(key, 0) > ROUNDS for key in senders)
                and all(of["friend"][got] for got in ("heard", "answers", "tokens"))
                and of["viewer"]["answers"].get(STOP, 0) > 1
                and of["nobody"]["connected"]
            )

        wait_until(everyone_has_acted)
        good = site.home.state()["good"][pulse("friend")]
        wait_until(lambda: site.home.state()["good"][pulse("friend")] > good + ROUNDS)
        return Found(site.home.state(), others.state())


NOTHING = {"heard": {}, "tokens": {}, "answers": {}}


def test_a_permitted_rack_is_heard_answered_and_sees_who_is_present(found: Found) -> None:
    assert found.home["good"][pulse("friend")] == found.home["came"][pulse("friend")]
    assert set(found.of["friend"]["tokens"]) >= {TOKEN}
    assert "friend came" in found.home["tokens"]


@pytest.mark.parametrize(
    ("name", "connected"),
    # The impostor's certificate is ours, but for another address.
    [("bare", False), ("plain", False), ("forged", False), ("impostor", False), ("nobody", True)],
)
def test_nobody_gets_anything_without_a_certificate_and_a_right(
    found: Found, name: str, connected: bool
) -> None:
    assert found.of[name] == {**NOTHING, "connected": connected}


def test_an_operator_may_only_stop_the_rack_and_nobody_else_may(found: Found) -> None:
    viewer = found.of["viewer"]
    assert set(viewer["answers"]) == {STOP}
    assert viewer["heard"] == {}
    # That others are there only home may know.
    assert set(viewer["tokens"]) == {TOKEN}
    assert set(found.home["asked"]) == {STOP, FRIENDS_STOP}


def test_wrong_names_wrong_seals_and_oversized_messages_are_refused(found: Found) -> None:
    home, second, heavy = found.home, out_key("liar", "second.status"), pulse("heavy")
    # Friend sends 100 bytes, all others 99 under its key: those would be good.
    assert set(home["came"]) == {out_key(*source.split("/")) for source in IMPORTED}
    assert home["sizes"][pulse("friend")] == [100]
    assert min(home["flaws"].values()) > ROUNDS / 2
    assert home["came"][second] > ROUNDS / 2
    assert home["good"][second] == 0
    assert 0 < home["good"][pulse("liar")] < home["came"][pulse("liar")]
    # A seal of another network.
    assert home["good"][pulse("mole")] == 0 < home["came"][pulse("mole")]
    # A huge message is not put together.
    assert home["good"][heavy] == home["came"][heavy] > 0
    assert home["sizes"][heavy] == [100]


def test_a_permitted_rack_can_connect_over_quic(tmp_path: Path) -> None:
    with at_home(tmp_path, "quic") as site:
        settings = site.mutual("friend") | {"connect/endpoints": [f"quic/127.0.0.1:{site.port}"]}
        assert site.home.state()["came"] == {}
        with running(
            "strangers", json.dumps({"friend": {**friend(site), "settings": settings}})
        ) as others:
            wait_until(
                lambda: all(others.state()["friend"][got] for got in ("heard", "answers", "tokens"))
            )
            wait_until(lambda: site.home.state()["good"].get(pulse("friend")))
