"""The bus as a program of the host side has it: ports, times, turns, and the crate's memory."""

from __future__ import annotations

import re
import time

import pytest

from rack.backplane.errors import MailboxError
from rack.backplane.message import State
from rack.backplane.semaphores import get_done_semaphore, get_wake_semaphore
from rack.backplane.words import Block, Head, System, TaskState
from rack.boards.host.bus import WORD, HostBus
from rack.levels.errors import LevelError
from rack.levels.host_program import HostProgram
from rack.levels.level import Input
from tests.boards.host.conftest import OpenBus, Site
from tests.boards.host_programs import Host, Sum
from tests.processes import BOUND_S, in_thread, wait_until

TICK_S = 0.0025


def test_an_open_bus_has_claimed_its_board(site: Site, open_bus: OpenBus) -> None:
    site.host[Block.WAITS_UNTIL] = 9
    bus = open_bus(site)
    assert (site.host[Block.STATE], site.host[Block.WAITS_UNTIL]) == (TaskState.RUNNING, 0)
    with pytest.raises(MailboxError, match="host board 'program' is already running"):
        HostBus(site.segment, site.plan.hosts[0])
    bus.close()
    HostBus(site.segment, site.plan.hosts[0]).close()


def test_no_fault_can_signal_a_program_of_another_pid_namespace(
    site: Site, open_bus: OpenBus
) -> None:
    site.segment.words[Head.LAUNCHER_NAMESPACE] += 1
    open_bus(site)
    assert site.host[Block.PID] == 0
    with pytest.raises(MailboxError, match="already running in another PID namespace"):
        HostBus(site.segment, site.plan.hosts[0])


def test_a_message_without_an_id_has_its_number(site: Site, program: Host) -> None:
    for number, value in ((1, 1.5), (40, 2.5), (3, 3.5)):
        message = program.numbers.message
        assert (message.id, message.value) == (program.numbers.sent + 1, 0.0)
        message.id = number
        message.value = value
        assert program.numbers.send()
    site.cycle()
    assert not program.sum.read().has_message
    ids = []
    entry = site.adapter._entries[0][1]
    ring = entry._ring._slots  # type: ignore[attr-defined]
    for serial in (1, 2, 3):
        assert ring.fetch_message(serial)
        ids.append((ring.message.id, ring.message.value, ring.message.colour))
    # A field that is not filled is zero, whatever the message before it had.
    assert ids == [(1, 1.5, 0), (40, 2.5, 0), (3, 3.5, 0)]
    assert program.numbers.sent == 3


def test_a_message_that_cannot_be_sent_is_not_cleared(site: Site, program: Host) -> None:
    while program.send_number(1.0):
        pass
    sent = program.numbers.sent
    assert sent == site.segment.layout.find_mailbox("program.numbers").capacity
    assert (program.numbers.message.id, program.numbers.message.value) == (sent + 1, 1.0)
    site.cycle()
    assert program.numbers.send()
    assert (program.numbers.sent, program.numbers.message.value) == (sent + 1, 0.0)


def test_unknown_fields_and_ports_of_levels_are_named(program: Host) -> None:
    with pytest.raises(AttributeError, match="message 'number' has no field 'speed'; fields: id, "):
        program.numbers.message.speed = 1.0  # type: ignore[attr-defined]
    assert program.sum.read().message.state is State.IDLE
    with pytest.raises(LevelError, match="'sum' is a level's Input; it must be a ProgramInput or "):

        class _OfALevel(HostProgram):
            sum = Input(Sum, "below.sum")


def test_the_crates_memory_is_read_by_bus_addresses(site: Site, open_bus: OpenBus) -> None:
    bus = open_bus(site)
    assert bus.tasks == ["bridge", "adder"]
    site.segment.get_block("adder")[Block.CYCLES] = 77
    address = bus.address("adder")
    assert bus.words(address + WORD * Block.CYCLES) == [77]
    assert bus.words(address, 3) == list(site.segment.get_block("adder")[:3])
    assert bus.address("adder.status") == site.segment.map.mailboxes["adder.status"]
    size = site.segment.map.size
    assert len(bus.words(size - WORD)) == 1
    for wrong, count in ((size - WORD, 2), (size, 1), (-WORD, 1), (4, 1), (0, 0)):
        with pytest.raises(ValueError, match="the bus has 0 to"):
            bus.words(wrong, count)
    with pytest.raises(LookupError, match="nothing on the bus is called 'x'; known: "):
        bus.address("x")


def test_a_program_writes_scratch_words_of_its_board_alone(site: Site, open_bus: OpenBus) -> None:
    bus = open_bus(site)
    places = site.segment.map
    for number, value in enumerate((7, -(1 << 63), (1 << 63) - 1)):
        bus.write(bus.scratch + WORD * number, value)
    assert bus.words(bus.scratch, 4) == [7, -(1 << 63), (1 << 63) - 1, 0]
    before = bytes(site.segment.get_bytes(0, places.size))
    for address, value, why in (
        (bus.scratch + 1, 1, "addresses must be multiples of 8"),
        (places.size, 1, "the bus has 0 to"),
        (-WORD, 1, "the bus has 0 to"),
        ("a", 1, "'a': addresses and counts must be integers"),
        (bus.scratch, 1.5, "1.5: must be a whole number from -2^63 to 2^63 - 1"),
        (bus.scratch, 1 << 63, "9223372036854775808: must be a whole number"),
        (
            WORD * System.TICK,
            1,
            "belongs to the words of the Rack, the system clock and its tables;",
        ),
        (
            bus.address("adder"),
            1,
            "the control block of 'adder' and its rings; 'program' may write",
        ),
        (
            bus.address("adder.status"),
            1,
            "to mailbox 'adder.status', whose messages have checksums",
        ),
        (places.operator, 1, "the system clock and its tables"),
        (places.traces["adder"] + WORD, 1, "the control block of 'adder' and its rings"),
        (places.wake["adder"], 1, "belongs to semaphores and locks"),
        (bus.scratch - WORD, 1, "belongs to semaphores and locks"),
    ):
        with pytest.raises(ValueError, match=re.escape(why)) as error:
            bus.write(address, value)  # type: ignore[arg-type]
        assert "\n" not in str(error.value)
    assert bytes(site.segment.get_bytes(0, places.size)) == before


@pytest.mark.parametrize("site", [("clock.mode=realtime",)], indirect=True)
def test_in_real_time_a_program_waits_for_a_message_or_its_timeout(
    site: Site, open_bus: OpenBus
) -> None:
    bus = open_bus(site)
    site.segment.words[System.TICK] = 40
    assert bus.tick == 40
    assert abs(bus.time_s - time.monotonic()) < 1.0
    began = time.monotonic()
    assert not bus.wait(0.02)
    assert time.monotonic() - began >= 0.02
    assert not bus.wait(-1.0)
    with in_thread(get_wake_semaphore(site.segment, "program").release):
        assert bus.wait(BOUND_S)
    bus.await_turn()
    bus.finish()
    assert site.host[Block.STATE] == TaskState.ENDED
    assert get_done_semaphore(site.segment, "program").value == 0


@pytest.mark.parametrize("site", [("host.program.computing_ms=5",)], indirect=True)
def test_in_lockstep_a_programs_time_is_the_tick_of_its_turn(site: Site, open_bus: OpenBus) -> None:
    site.segment.words[System.LOCKSTEP] = 1
    site.host[Block.RELEASED] = 8
    bus = open_bus(site)
    done = get_done_semaphore(site.segment, "program")
    wake = get_wake_semaphore(site.segment, "program")
    assert (bus.tick, bus.time_s) == (8, pytest.approx(8 * TICK_S))
    seen: list[tuple[bool, int]] = []

    def wait(timeout_s: float) -> None:
        seen.append((bus.wait(timeout_s), bus.tick))

    for timeout_s, until in ((0.05, 28), (0.0, 9), (1e300, 8 + round(1e9 / TICK_S))):
        site.host[Block.RELEASED] = 8
        site.host[Block.DONE] = 0
        with in_thread(lambda timeout_s=timeout_s: wait(timeout_s)):
            wait_until(lambda: done.value)
            assert (site.host[Block.DONE], site.host[Block.DEADLINE]) == (8, 10)
            assert site.host[Block.WAITS_UNTIL] == until
            assert done.try_acquire()
            # Its next turn, because a message has come.
            site.host[Block.WAITS_UNTIL] = 0
            site.host[Block.RELEASED] = 12
            wake.release()
    assert seen == [(True, 12)] * 3
    bus.finish()
    assert (done.value, site.host[Block.DONE]) == (1, 12)


def test_a_program_in_lockstep_runs_only_in_its_turn(site: Site, open_bus: OpenBus) -> None:
    site.segment.words[System.LOCKSTEP] = 1
    block = site.host
    bus = open_bus(site)
    for word, blocked, free in ((Block.LOST, 5, 0), (Block.DONE, 8, 4)):
        block[Block.RELEASED] = 8
        block[Block.DONE] = 4
        block[word] = blocked
        passed: list[bool] = []
        with in_thread(lambda passed=passed: passed.append(bus.await_turn() is None)):
            assert passed == []
            block[word] = free
            get_wake_semaphore(site.segment, "program").release()
        assert passed == [True]
