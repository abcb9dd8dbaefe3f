"""Rules on mailboxes: which messages may interrupt the boards that read them."""

from __future__ import annotations

import pytest

from rack.boards.config import resolve
from rack.boards.config.files import Assembled
from rack.boards.config.loader import validate
from rack.boards.config.toml import apply_settings, parse_tables
from rack.boards.errors import ConfigError
from tests.boards.host.test_board import HOSTED
from tests.boards.lan.racks import rack_text
from tests.boards.test_queues import QUEUES


def mistake(text: str, *settings: str) -> str:
    with pytest.raises(ConfigError) as error:
        resolve(validate(Assembled(apply_settings(parse_tables(text), settings, []))))
    (found,) = error.value.mistakes
    return str(found)


def test_a_queue_and_mailboxes_beyond_the_boards_are_refused() -> None:
    assert "sends any number of messages in a cycle; must be queue" in mistake(
        QUEUES, "protocol.mailbox={ 'upper.requests' = 'interrupt' }"
    )
    for mailbox in ("program.numbers", "bridge.sum"):
        found = mistake(HOSTED, f"protocol.mailbox={{ '{mailbox}' = 'interrupt' }}")
        assert found.startswith(
            f'protocol.mailbox.{mailbox} = "interrupt": it is on the host side, where nothing is'
        )
    network = rack_text("here", "tcp/127.0.0.1:7001", (), "there")
    found = mistake(network, "protocol.mailbox={ 'lan.other' = 'interrupt' }")
    assert "the network adapter writes it; must be time-slice or double-buffer" in found
