"""Queues through the ports of two tasks: fullness and order by ticks alone, alarms, and faults of
messages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import monotonic_ns
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rack.backplane.fault_table import FaultEntry, FaultTable, Injection
from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.trace import FIELDS, TraceWriter
from rack.backplane.watch.alarms import Alarm, AlarmWriter, open_alarm_ring
from rack.boards.faults import message_steps as messages
from rack.boards.faults.kind import KINDS
from rack.boards.run.ports import InputPorts, OutputPorts
from rack.levels.level import Reading
from tests.backplane.bus import NAME, layout, queue, task
from tests.bare_level import BareLevel
from tests.processes import FORKS, exit_status, fork

pytestmark = pytest.mark.filterwarnings(FORKS)


class QueueLink:
    """A writing task that numbers its messages, and a reading task that keeps what it takes.

    `refused` are the serials that the queue did not take.
    """

    def __init__(self, segment: Segment, sends: bool = True) -> None:
        self.segment = segment
        self.rates = tuple(segment.layout.find_task(name).every for name in ("writer", "reader"))
        self.writing, self.reading = BareLevel(), BareLevel()
        heard = AlarmWriter(segment, "reader")
        self._sent = ("point",) if sends else ()
        self._open_writer()
        self.reads = InputPorts(segment, self.reading, {"point": NAME}, heard)
        self._trace = TraceWriter(segment, "writer")
        self.serial = 0
        self.taken: list[int] = []
        self.refused: list[int] = []
        self._rings = {name: open_alarm_ring(segment, name) for name in ("writer", "reader")}

    def _open_writer(self) -> None:
        alarms = AlarmWriter(self.segment, "writer")
        self._inputs = InputPorts(self.segment, self.writing, {}, alarms)
        self.ports = OutputPorts(
            self.segment, self.writing, {"point": NAME}, alarms, self._inputs, self._sent
        )

    def restart_writer(self) -> None:
        """Replace the writing task, as a restart does."""
        for writer in self.ports.writers.values():
            writer.close()
        self._open_writer()

    def write(self, tick: int, count: int) -> None:
        """Do the writer's cycle, and send that many messages."""
        self._inputs.read(tick)
        port = self.writing.ports["point"]
        for _ in range(count):
            message = port.message
            self.serial += 1
            message.id, message.row = self.serial, self.serial
            if not port.send():
                self.refused.append(self.serial)
        self.ports.write(tick, tick)
        # A late message is one whose cycle has ended before: this is its end.
        record = dict.fromkeys(FIELDS, 0) | {"tick": tick, "end_ns": monotonic_ns()}
        self._trace.write(*record.values())

    def read(self, tick: int) -> Reading:
        self.reads.read(tick)
        reading: Reading[Any] = self.reading.ports["point"]
        if reading.is_new:
            self.taken += [message.id for message in (*reading.earlier, reading.message)]
        return reading

    def run(
        self, first: int, last: int, bursts: Callable[[int], int], reader_first: bool = False
    ) -> None:
        """Do the ticks from `first` up to and without `last`."""
        for tick in range(first, last):
            steps = [
                lambda tick=tick: self.write(tick, bursts(tick)),
                lambda tick=tick: self.read(tick),
            ]
            due = [step for step, every in zip(steps, self.rates, strict=True) if tick % every == 0]
            for step in reversed(due) if reader_first else due:
                step()

    def alarms(self, name: str) -> list[Alarm]:
        """Return what a task has rung since the last call."""
        return [Alarm(row["code"]) for row in self._rings[name].read_new_rows().rows]

    def fault(self, kind: str, *parameters: float) -> FaultEntry:
        values = [p.default or 0.0 for p in KINDS[kind].parameters]
        entry = FaultTable(self.segment).add_fault(
            Injection(
                KINDS[kind].number,
                0,
                -1,
                seed=7,
                parameters=(*parameters, *values[len(parameters) :]),
            )
        )
        self.ports.apply_faults([entry])
        return entry

    def close(self) -> None:
        for writer in self.ports.writers.values():
            writer.close()
        for reader in self.reads.readers.values():
            reader.close()  # type: ignore[attr-defined]
        self.segment.close()
        unlink_segment(self.segment.rack)


def create_segment(rack: str, capacity: int, rates: tuple[int, int]) -> Segment:
    tasks = task("writer", every=rates[0], depth=64), task("reader", every=rates[1], slot=3)
    return Segment.create(layout(rack, queue(capacity, rates), tasks), "")


MakeQueue = Callable[..., QueueLink]


@pytest.fixture
def link(rack_name: str) -> Iterator[MakeQueue]:
    made: list[QueueLink] = []

    def make(capacity: int = 8, rates: tuple[int, int] = (1, 1), sends: bool = True) -> QueueLink:
        segment = create_segment(f"{rack_name}-{len(made)}", capacity, rates)
        made.append(QueueLink(segment, sends))
        return made[-1]

    yield make
    for one in made:
        one.close()


@settings(max_examples=40)
@given(
    capacity=st.integers(1, 6),
    rates=st.tuples(st.integers(1, 6), st.integers(1, 6)),
    bursts=st.lists(st.integers(0, 5), min_size=1, max_size=40),
    rooms=st.lists(st.integers(0, 4), min_size=1, max_size=12),
)
def test_order_and_fullness_depend_on_ticks_alone(
    capacity: int, rates: tuple[int, int], bursts: list[int], rooms: list[int]
) -> None:
    runs = []
    for reader_first in (False, True):
        rack = QueueLink(create_segment(f"test-queue-{id(bursts)}", capacity, rates))
        try:
            most = 0
            for tick in range(80):
                rack.reading.most = rooms[tick % len(rooms)]
                rack.run(tick, tick + 1, lambda tick: bursts[tick % len(bursts)], reader_first)
                most = max(most, rack.serial - len(rack.refused) - len(rack.taken))
            rack.reading.most = 99
            rack.run(80, 100, lambda tick: 0, reader_first)
        finally:
            rack.close()
        sent = [serial for serial in range(1, rack.serial + 1) if serial not in rack.refused]
        assert rack.taken == sent
        assert most <= capacity
        runs.append((rack.taken, rack.refused))
    assert runs[0] == runs[1]


def test_a_full_queue_raises_one_alarm_per_episode(link: MakeQueue) -> None:
    rack = link(2)
    rack.reading.most = 0
    rack.run(0, 30, lambda tick: 1)
    assert rack.alarms("writer") == [Alarm.QUEUE_FULL]
    assert rack.refused == [*range(3, 31)]
    rack.reading.most = 9
    rack.run(30, 34, lambda tick: 0)
    assert rack.taken == [1, 2]
    rack.run(34, 80, lambda tick: tick % 2)
    rack.reading.most = 0
    rack.run(80, 90, lambda tick: 1)
    assert rack.alarms("writer") == [Alarm.QUEUE_FULL]


def test_a_level_that_does_not_send_queues_one_message_a_cycle(link: MakeQueue) -> None:
    rack = link(2, sends=False)
    for tick in range(6):
        message = rack.ports.writers["point"].message
        message.id, message.row = tick + 1, tick + 1
        rack.write(tick, 0)
        if tick == 3:
            rack.read(tick)
    assert rack.taken == [1, 2]
    assert rack.alarms("writer") == [Alarm.QUEUE_FULL]
    assert [rack.read(9).message.id, rack.taken] == [6, [1, 2, 5, 6]]


FOUND = {
    "drop": (Alarm.GAP, (0.5,)),
    "corrupt": (Alarm.DAMAGED, (0.5, 3)),
    "delay": (Alarm.HELD_BACK, (3,)),
}


@pytest.mark.parametrize("kind", FOUND)
@pytest.mark.parametrize("rates", [(1, 1), (1, 4), (4, 1)])
def test_a_message_fault_is_detected_and_later_messages_are_read(
    link: MakeQueue, kind: str, rates: tuple[int, int]
) -> None:
    alarm, parameters = FOUND[kind]
    rack = link(16, rates)
    rack.run(0, 16, lambda tick: 2)
    rack.fault(kind, *parameters)
    rack.run(16, 48, lambda tick: 2)
    rack.ports.apply_faults([])
    rack.run(48, 96, lambda tick: 1)
    rack.run(96, 128, lambda tick: 0)
    assert rack.alarms("reader") == [alarm]
    assert rack.taken == sorted(set(rack.taken))
    assert rack.taken[-1] == rack.serial
    lost = rack.serial - len(rack.refused) - len(rack.taken)
    assert lost > 0 if kind != "delay" else lost == 0


@pytest.mark.parametrize("kind", ["mute", "reorder", "babble"])
def test_an_undetectable_fault_is_not_applied_to_a_queue(link: MakeQueue, kind: str) -> None:
    rack = link()
    entry = rack.fault(kind)
    rack.run(0, 8, lambda tick: 1)
    assert (rack.taken, entry.count) == ([*range(1, 8)], 0)


@pytest.mark.parametrize("is_restarted", [False, True])
def test_a_forged_message_is_not_read_and_displaces_no_message_nor_a_new_writer(
    link: MakeQueue, is_restarted: bool
) -> None:
    rack = link()
    rack.run(0, 4, lambda tick: 1)
    forging = fork(lambda: messages.forge_message(rack.segment, NAME, 4))
    assert exit_status(forging) == 0
    rack.read(4)
    assert rack.alarms("reader") == [Alarm.MASQUERADE]
    if is_restarted:
        rack.restart_writer()
    rack.run(5, 8, lambda tick: 1)
    rack.run(8, 10, lambda tick: 0)
    assert rack.taken == [*range(1, rack.serial + 1)]
    assert rack.alarms("writer") == [Alarm.MASQUERADE] * (not is_restarted)
