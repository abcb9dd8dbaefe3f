"""Rules on mailboxes: which messages may interrupt the boards that read them, and that the clock
waits for nobody."""

from __future__ import annotations

import pytest

from tests.boards.commanded_racks import COMMANDED
from tests.boards.config.mistakes import find_mistake
from tests.boards.host.test_board import HOSTED
from tests.boards.lan.racks import rack_text
from tests.boards.test_queues import QUEUES


def test_a_queue_and_mailboxes_beyond_the_boards_are_refused() -> None:
    assert "sends any number of messages in a cycle; must be queue" in find_mistake(
        QUEUES, "protocol.mailbox={ 'upper.requests' = 'interrupt' }"
    )
    for mailbox in ("program.numbers", "bridge.sum"):
        found = find_mistake(HOSTED, f"protocol.mailbox={{ '{mailbox}' = 'interrupt' }}")
        assert found.startswith(
            f'protocol.mailbox.{mailbox} = "interrupt": it is on the host side, where nothing is'
        )
    network = rack_text("here", "tcp/127.0.0.1:7001", (), "there")
    found = find_mistake(network, "protocol.mailbox={ 'lan.other' = 'interrupt' }")
    assert "the network adapter writes it; must be time-slice or double-buffer" in found


@pytest.mark.parametrize(
    ("protocol", "why"),
    [
        ("lock", "the clock writes it and must not wait"),
        ("interrupt", "the clock writes it, not a board; must be time-slice or double-buffer"),
    ],
)
def test_the_clock_takes_no_lock_for_an_operator(protocol: str, why: str) -> None:
    setting = f"protocol.mailbox={{'upper.operator' = '{protocol}'}}"
    assert why in find_mistake(COMMANDED, setting)
