"""The digest: over ticks and values, not over time, and only up to its tick."""

from __future__ import annotations

import pytest

from rack.backplane.mailbox.history import compute_digest, find_chains
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.segment import Segment
from rack.boards.faults.message_steps import forge_message
from tests.backplane.bus import NAME, mailbox, message_address
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, fork

pytestmark = pytest.mark.filterwarnings(FORKS)

OTHER = "writer.other"


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(mailbox(every=2, delay=2), mailbox(every=2, delay=2, name=OTHER))


def write(segment: Segment, name: str, values: list[int]) -> None:
    """Write these values under a new writer, from tick 0 on."""
    writer = open_writer(segment, name)
    for at, value in enumerate(values):
        writer.message.row[:] = value
        writer.write(2 * at)
    writer.close()


def test_equal_messages_have_equal_chains_whenever_they_were_written(bus: Segment) -> None:
    write(bus, NAME, [1, 2, 3])
    write(bus, OTHER, [1, 2, 3])
    found = find_chains(bus, 100)
    assert found[NAME] == found[OTHER]
    assert found[NAME][0] == 3


@pytest.mark.parametrize("values", [[1, 2], [1, 2, 4], [2, 1, 3], [0, 2, 3], [1, 2, 3, 3]])
def test_any_difference_changes_the_digest(bus: Segment, values: list[int]) -> None:
    write(bus, NAME, [1, 2, 3])
    write(bus, OTHER, values)
    found = find_chains(bus, 100)
    assert found[NAME][1] != found[OTHER][1]


def test_messages_visible_after_the_last_tick_do_not_count(bus: Segment) -> None:
    write(bus, NAME, [1, 2, 3])
    assert [find_chains(bus, until)[NAME][0] for until in (2, 3, 4, 5, 6, 7)] == [0, 1, 1, 2, 2, 3]
    before = compute_digest(bus, 7), compute_digest(bus, 9)
    open_writer(bus, NAME).write(6)
    assert compute_digest(bus, 7) == before[0]
    assert compute_digest(bus, 9) != before[1]
    assert compute_digest(bus, 4) != compute_digest(bus, 7)


def test_the_chain_covers_overwritten_messages(bus: Segment) -> None:
    write(bus, NAME, list(range(500)))
    write(bus, OTHER, [-1, *range(1, 500)])
    found = find_chains(bus, 5000)
    assert found[NAME][0] == found[OTHER][0] == 500
    assert found[NAME][1] != found[OTHER][1]
    # Where no message is left there is no chain.
    assert find_chains(bus, 3)[NAME][1] == 0


def test_the_chain_of_a_damaged_message_is_replaced_by_the_one_before_it(bus: Segment) -> None:
    write(bus, NAME, list(range(500)))
    before = find_chains(bus, 999)[NAME]
    bus.bytes[message_address(bus, 500)] ^= 1
    assert find_chains(bus, 5000)[NAME] == before == (499, before[1])
    assert before[1] != bytes(8)


def test_a_forged_message_is_no_part_of_the_run(bus: Segment) -> None:
    write(bus, NAME, [1, 2, 3])
    before = find_chains(bus, 100)[NAME]
    assert exit_status(fork(lambda: forge_message(bus, NAME, 6))) == 0
    assert find_chains(bus, 100)[NAME] == before
