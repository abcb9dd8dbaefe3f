"""Racks whose seals alone prove who they are: what another one sends in their name is refused."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rack.backplane.errors import BackplaneError
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.tools.network.certificates import make_credentials
from tests.boards.lan.forger import FORGED, LATER
from tests.boards.lan.racks import LAUNCH_S, configs, endpoints, rack_text, started
from tests.boards.lan.test_strangers import running
from tests.processes import wait_until

pytestmark = pytest.mark.slow
ROUNDS = 20


def taken(rack: str) -> int:
    """Return the messages of the other rack that a rack has taken so far."""
    with suppress(BackplaneError):
        segment = Segment.attach(rack)
        try:
            status = open_observer(segment, "lan.status").peek()
            return int(status.message.import_other["taken"]) if status.has_message else 0
        finally:
            segment.close()
    return 0


@pytest.mark.thorough
def test_a_rack_that_sends_under_another_name_is_refused(rack_name: str, tmp_path: Path) -> None:
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
            return int(status.peek().message.import_other[count])

        before = taken(names[1])
        wait_until(lambda: taken(names[1]) > before + ROUNDS)
        wait_until(lambda: imported("repeated") > ROUNDS)
        did, heard = forger.state(), echo.peek().message
        wait_until(lambda: int(status.peek().message.flaws["unsigned"]) >= did["forged"])
        assert did["opened"] == did["heard"]
        assert imported("refused") >= did["forged"]
        # A message that was forged and taken would make all up to it missing. Some may be: of 32
        # that wait, the newest stay, and that is 0.1 s of what the forger sends.
        assert imported("missing") < LATER - 1
        assert 0 < heard.count < heard.total < FORGED
        assert heard.backward == 0
