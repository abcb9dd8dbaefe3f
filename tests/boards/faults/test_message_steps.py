"""Faults of a writer: they act on its messages, are detected by the reader within their bounds, and
end."""

from __future__ import annotations

import os
import signal

import pytest

from rack.backplane.fault_table import FaultEntry, FaultTable, Injection
from rack.backplane.layout import PROTOCOLS, Protocol
from rack.backplane.mailbox.mailbox import Verdict
from rack.backplane.process import read_state
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults import message_steps as messages
from rack.boards.faults.kind import KINDS
from tests.backplane.bus import NAME
from tests.link import Link, MakeLink, WritingTask
from tests.processes import FORKS, exit_status, fork, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)
RATES = [(1, 8), (8, 1), (2, 3)]
"""Periods of writer and reader."""
FAULTS: dict[str, tuple[float, ...]] = {
    "mute": (),
    "drop": (0.5,),
    "delay": (3,),
    "reorder": (0.5,),
    "corrupt": (0.6, 3),
    "babble": (16,),
}
ALSO = {"delay": {Alarm.MUTE}, "reorder": {Alarm.HELD_BACK}}
"""Other permitted alarms: a delayed message is at first missing; the last swapped message is
late."""
BEGIN, END, LAST = 64, 160, 320


def run_with_fault(rack: Link, kind: str) -> FaultEntry | None:
    """Run a link before, during and after a fault. A forged message has no entry in the table."""
    rack.run(0, BEGIN)
    assert rack.alarms("reader") == rack.alarms("writer") == []
    assert not any(seen.is_lost for seen in rack.reader.seen)
    entry = rack.fault(kind, *FAULTS[kind]) if kind in FAULTS else forge(rack, BEGIN)
    rack.run(BEGIN, END)
    rack.heal()
    rack.run(END, LAST)
    return entry


def run_spell(rack: Link, ticks: tuple[int, int, int], kind: str, *parameters: float) -> FaultEntry:
    """Run a link with a fault from the first of these ticks to the second, up to the last."""
    begin, end, last = ticks
    rack.run(0, begin)
    entry = rack.fault(kind, *parameters)
    rack.run(begin, end)
    rack.heal()
    rack.run(end, last)
    return entry


def forge(rack: Link, tick: int) -> None:
    assert exit_status(fork(lambda: messages.forge_message(rack.segment, NAME, tick))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("reader_first", [False, True])
@pytest.mark.parametrize("rates", RATES)
@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_is_detected_within_its_bound_and_identified_and_nothing_before_it(
    link: MakeLink, kind: str, protocol: Protocol, rates: tuple[int, int], reader_first: bool
) -> None:
    rack = link(protocol, rates, reader_first)
    entry = run_with_fault(rack, kind)
    assert entry is not None
    about = KINDS[kind]
    injection = Injection(about.number, 0, 0, parameters=FAULTS[kind])
    bound = about.compute_bound_ticks(injection, rack.segment.layout, "reader")
    alarms = rack.alarms()
    found = [tick for tick, code in alarms if code in about.detected_as]
    assert found
    assert bound is not None
    assert found[0] - entry.struck_tick <= bound
    assert {code for _, code in alarms} - set(about.detected_as) <= ALSO.get(kind, set())
    assert len(found) <= 2


@pytest.mark.slow
@pytest.mark.parametrize("rates", RATES)
@pytest.mark.parametrize("kind", [*FAULTS, "masquerade"])
def test_reads_with_a_fault_depend_on_ticks_alone(
    link: MakeLink, kind: str, rates: tuple[int, int]
) -> None:
    runs = []
    for reader_first in (False, True):
        rack = link("time-slice", rates, reader_first)
        run_with_fault(rack, kind)
        runs.append((rack.reader.seen, rack.alarms(), rack.written()))
    (seen, alarms, written), (seen_again, alarms_again, written_again) = runs
    assert seen == seen_again
    assert written == written_again
    # A forged message lasts until the true writer's next one: only a reader that comes before sees
    # it.
    assert alarms == alarms_again or kind == "masquerade"


def test_a_dropped_message_uses_a_serial_but_fills_no_slot(link: MakeLink) -> None:
    rack = link()
    entry = run_spell(rack, (8, 40, 44), "drop", 0.5)
    written = rack.written()
    assert len(written) == 44 - entry.count
    assert [serial for _, serial, _ in written] == [tick + 1 for tick, *_ in written]
    assert 4 < entry.count < 28


@pytest.mark.parametrize("every", [1, 4])
def test_a_delayed_message_keeps_its_tick_and_comes_cycles_later(
    link: MakeLink, every: int
) -> None:
    rack = link(rates=(every, 1))
    rack.run(0, 8 * every)
    rack.fault("delay", 3)
    rack.run(8 * every, 16 * every)
    assert [tick // every for tick, *_ in rack.written()] == [*range(8), *range(8, 13)]
    assert [seen.released // every for seen in rack.reader.seen[-every:]] == [11] * every
    rack.heal()
    rack.run(16 * every, 20 * every)
    # Late ones and the present one come in order, and none is lost.
    assert [tick // every for tick, *_ in rack.written()] == [*range(20)]
    assert rack.reader.seen[-1].released // every == 18


def test_reordered_messages_are_swapped(link: MakeLink) -> None:
    rack = link()
    run_spell(rack, (4, 8, 10), "reorder", 1.0)
    assert [tick for tick, *_ in rack.written()] == [0, 1, 2, 3, 5, 4, 7, 6, 8, 9]
    # The older one has the newer place, so it is the one that is read.
    assert [seen.released for seen in rack.reader.seen] == [-1, 0, 1, 2, 3, 3, 4, 4, 6, 8]


def test_a_damaged_message_is_skipped_and_the_next_intact_one_is_read(link: MakeLink) -> None:
    rack = link()
    entry = run_spell(rack, (8, 10, 12), "corrupt", 1.0, 1)
    assert entry.count == 2
    # A writer comes first in a tick, and what it writes is visible a tick later.
    assert [seen.released for seen in rack.reader.seen[7:]] == [6, 7, 7, 7, 10]


@pytest.mark.parametrize("bits", [1, 2, 16, 64])
def test_every_damage_is_detected(link: MakeLink, bits: int) -> None:
    rack = link()
    rack.fault("corrupt", 1.0, bits)
    rack.run(0, 50)
    assert not any(seen.released >= 0 for seen in rack.reader.seen)


def test_babble_writes_the_given_number_of_messages_per_cycle(link: MakeLink) -> None:
    rack = link()
    run_spell(rack, (4, 6, 6), "babble", 40)
    assert [tick for tick, *_ in rack.written()] == [0, 1, 2, 3] + [4] * 40 + [5] * 40


def test_faults_of_one_mailbox_compose(link: MakeLink) -> None:
    rack = link()
    rack.run(0, 32)
    for kind, *parameters in (("drop", 0.3), ("corrupt", 0.5, 2), ("babble", 4)):
        rack.fault(kind, *parameters)
    rack.run(32, 96)
    assert {code for _, code in rack.alarms()} == {Alarm.GAP, Alarm.DAMAGED, Alarm.BABBLE}
    rack.heal()
    rack.run(96, 99)
    assert rack.reader.seen[-1] == (98, 97, "NEW", False)


def test_a_fault_keeps_its_delayed_messages_when_another_begins(link: MakeLink) -> None:
    rack = link()
    rack.fault("delay", 2)
    rack.run(0, 8)
    rack.fault("corrupt", 0.001)
    rack.run(8, 12)
    assert [tick for tick, *_ in rack.written()] == [*range(10)]


def test_a_late_cycle_is_late_even_with_a_fault(link: MakeLink) -> None:
    rack = link()
    rack.fault("corrupt", 0.001)
    assert rack.writer.cycle(0, now=0)
    assert not rack.writer.cycle(1, now=5)
    assert rack.written()[-1] == (1, 2, 6)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_forged_message_is_never_delivered(link: MakeLink, protocol: Protocol) -> None:
    rack = link(protocol, reader_first=True)
    rack.run(0, 8)
    forge(rack, 8)
    reading = rack.reader.cycle(8)
    assert (reading.message.id, reading.verdict) == (7, Verdict.NEW)
    assert rack.alarms() == [(8, Alarm.MASQUERADE)]
    # The true writer takes its mailbox back, and reports it.
    rack.writer.cycle(8)
    assert rack.alarms("writer") == [(8, Alarm.MASQUERADE)]
    rack.run(9, 12)
    assert [tick for tick, *_ in rack.written()] == [*range(12)]
    assert [seen.verdict for seen in rack.reader.seen[9:]] == ["NEW"] * 3


@pytest.mark.parametrize("is_killed", [False, True])
def test_a_process_that_ends_in_the_critical_section_is_detected_by_the_next_wait(
    link: MakeLink, is_killed: bool
) -> None:
    rack = link("lock")
    rack.run(0, 4)
    rack.writer.close()
    entry = FaultTable(rack.segment).add_fault(
        Injection(KINDS["lock-held"].number, 0, parameters=(float(is_killed),))
    )

    def write() -> None:
        writer = WritingTask(rack.segment)
        writer.ports.apply_faults([entry])
        writer.cycle(4)

    with forked(write) as pid:
        wait_until(lambda: read_state(pid) in ("Z" if is_killed else "T"))
        assert (entry.struck_tick, entry.count) == (4, 1)
        reading = rack.reader.cycle(5)
        # The lock of a dead process goes to the waiter; a stopped process keeps it.
        assert reading.verdict is (Verdict.OLD if is_killed else Verdict.BUS_ERROR)
        assert reading.message.id == 3
        assert rack.alarms() == [(5, Alarm.LOCKED)]
        if not is_killed:
            os.kill(pid, signal.SIGCONT)
            assert exit_status(pid) == 0
            assert rack.reader.cycle(6).message.id == 4
