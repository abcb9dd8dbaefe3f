"""Whole racks, each with its own certificate: over TLS, and where only their seals prove it."""

from __future__ import annotations

import signal
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rack.backplane.errors import BackplaneError
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.boards.config import load, resolve
from rack.boards.errors import ConfigError
from rack.tools.network.certificates import make_credentials
from tests.boards.lan.forger import FORGED, LATER
from tests.boards.lan.racks import LAUNCH_S, configs, endpoints, rack_text, started
from tests.boards.lan.test_strangers import running
from tests.processes import wait_until

pytestmark = pytest.mark.slow
ROUNDS = 20


@pytest.fixture
def names(rack_name: str, tmp_path: Path) -> list[str]:
    """Two racks with certificates; the second connects to the first. Their configs are rack-0.toml
    and rack-1.toml."""
    names = [f"{rack_name}-{end}" for end in "ab"]
    make_credentials(tmp_path / "certs", {name: ["127.0.0.1"] for name in names}, 1)
    at, own = endpoints(1)[0].replace("tcp", "tls"), 'certificates = "certs"'
    texts = [
        rack_text(names[0], at, (), names[1], lan=own),
        rack_text(names[1], "", (at,), names[0], lan=own),
    ]
    configs(texts, tmp_path)
    return names


def taken(rack: str) -> int:
    """Return the messages of the other rack that a rack has taken so far."""
    with suppress(BackplaneError):
        segment = Segment.attach(rack)
        try:
            status = open_observer(segment, "lan.status").peek()
            return int(status.value.import_other["taken"]) if status.is_there else 0
        finally:
            segment.close()
    return 0


def test_racks_exchange_mailboxes(names: list[str], tmp_path: Path) -> None:
    with ExitStack() as stack:
        racks = [stack.enter_context(started(tmp_path / f"rack-{at}.toml")) for at in range(2)]
        wait_until(lambda: all(taken(name) > 3 for name in names), LAUNCH_S)
        for rack in racks:
            rack.send(signal.SIGTERM)
        for rack in racks:
            assert rack.outcome()["cause"] == "stopped"


def test_a_rack_under_another_name_needs_another_certificate(
    names: list[str], tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=rf"{names[0]}x\.pem: missing"):
        resolve(load(tmp_path / "rack-0.toml", [f"name={names[0]}x"]))


def test_a_rack_that_speaks_in_the_name_of_another_is_refused(
    rack_name: str, tmp_path: Path
) -> None:
    names = [f"{rack_name}-{end}" for end in "ab"]
    for folder in ("certs", "certs/theirs"):
        make_credentials(tmp_path / folder, dict.fromkeys([*names, "forger"], ()), 1)
    # Without TLS: with it a rack does not even hear another one under this name.
    at, own = endpoints(2), 'certificates = "certs"'
    texts = [
        rack_text(names[0], at[0], (), lan=own, peers=names[1:], insecure=False),
        rack_text(names[1], at[1], at[:1], names[0], lan=own, insecure=False),
    ]
    configs(texts, tmp_path)
    with ExitStack() as stack:
        for k in range(2):
            stack.enter_context(started(tmp_path / f"rack-{k}.toml"))
        wait_until(lambda: taken(names[1]) > ROUNDS, LAUNCH_S)
        members = [str(tmp_path / "certs"), "forger", names[0]]
        forger = stack.enter_context(running("forger", *members, *at))
        wait_until(lambda: forger.state()["forged"] > ROUNDS)
        segment = Segment.attach(names[1])
        stack.callback(segment.close)
        status, echo = (open_observer(segment, name) for name in ("lan.status", "echo.status"))

        def imported(count: str) -> int:
            return int(status.peek().value.import_other[count])

        before = taken(names[1])
        wait_until(lambda: taken(names[1]) > before + ROUNDS)
        wait_until(lambda: imported("repeated") > ROUNDS)
        did, heard = forger.state(), echo.peek().value
        wait_until(lambda: int(status.peek().value.flaws["unsigned"]) >= did["forged"])
        assert did["opened"] == did["heard"]
        assert imported("refused") >= did["forged"]
        # A message that was forged and taken would make all up to it missing. Some may be: of 32
        # that wait, the newest stay, and that is 0.1 s of what the forger sends.
        assert imported("missing") < LATER - 1
        assert 0 < heard.count < heard.total < FORGED
        assert heard.backward == 0
