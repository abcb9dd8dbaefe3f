"""Machine code and the Python classes, driven by the same operations on two buses: every byte and
every verdict is the same."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rack.backplane.address_map import MAILBOX_HEAD_SIZE, compute_slot_stride
from rack.backplane.errors import MailboxError
from rack.backplane.layout import Protocol
from rack.backplane.mailbox.mailbox import GOOD_OFFSET, Reader, ReadStatistics, Writer
from rack.backplane.mailbox.slots import Slots, build_signature
from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.watch.alarms import CLEAN_READS, Alarm, AlarmWriter
from rack.backplane.words import Block, Box, Slot
from rack.boards.run.port_tables import WriteTable, get_address
from rack.boards.run.ports import OutputPorts
from tests.backplane.bus import NAME, SIZES, Point, layout, mailbox, task
from tests.backplane.conftest import MakeBus
from tests.bare_level import BareLevel
from tests.conftest import EXHAUSTIVE
from tests.link import Link, ReadingTask, WritingTask, accesses

ANSWER = "reader.answer"
DEPTH = 8
STRANGER = 4321
"""A process that has not claimed the mailbox."""
NUMBERS = count()
AT_LENGTH = 1000 if EXHAUSTIVE else 150
"""Examples with more operations."""
FAULTS: dict[str, tuple[float, ...]] = {
    "mute": (),
    "drop": (0.6,),
    "delay": (),
    "reorder": (0.6,),
    "corrupt": (0.6,),
    "babble": (3,),
}
Operation = tuple[Any, ...]


class End:
    """A link on a bus of its own whose reader answers: its messages rest on what it reads."""

    def __init__(self, protocol: Protocol, rates: tuple[int, int], is_compiled: bool) -> None:
        point = mailbox(protocol, every=rates[0], delay=rates[0], depth=DEPTH)
        answer = replace(
            mailbox(every=rates[1], delay=rates[1], depth=DEPTH, name=ANSWER, writer="reader"),
            readers=("writer",),
            rests_on=(NAME,),
        )
        tasks = task("writer", every=rates[0], depth=64), task("reader", every=rates[1], slot=3)
        name = f"compiled-{os.getpid()}-{next(NUMBERS)}"
        self.segment = segment = Segment.create(layout(name, [point, answer], tasks), "")
        self.tick = 0
        self.results: list[object] = []
        self._is_compiled = is_compiled
        self._link = Link(segment, is_compiled=is_compiled)
        self._answers = self._open_answers()

    def _open_answers(self) -> OutputPorts:
        inputs = self._link.reader.ports
        alarms = AlarmWriter(self.segment, "reader")
        level = BareLevel()
        with accesses(self._is_compiled):
            return OutputPorts(self.segment, level, {"answer": ANSWER}, alarms, inputs)

    def write(self, late: int) -> None:
        """Write in a cycle that ends `late` ticks after its release."""
        now = self.tick + late if late else None
        self.results.append(self._link.writer.cycle(self._release("writer"), now))

    def read(self) -> None:
        """Read, and answer."""
        tick = self._release("reader")
        message = self._link.reader.cycle(tick).message
        self.results.append((bytes(message.raw), self._answers.write(tick, None)))

    def cycle(self, count: int) -> None:
        """Let both ends cycle."""
        for _ in range(count):
            self.write(0)
            self.advance(1)
            self.read()

    def _release(self, name: str) -> int:
        every = self.segment.layout.find_task(name).every
        return self.tick - self.tick % every

    def advance(self, ticks: int) -> None:
        """Let time pass."""
        self.tick += ticks

    def fault(self, kind: str) -> None:
        """Write with a fault more."""
        self._link.fault(kind, *FAULTS[kind])

    def heal(self) -> None:
        """Write without faults."""
        self._link.heal()

    def restart_writer(self, copied: float) -> None:
        """Kill the writer when it has filled that part of its next slot, and start another."""
        slots = Slots(self.segment, self.segment.layout.find_mailbox(NAME))
        slots.fetch_message(slots.box[Box.HEAD])
        slots.serial += 1
        size = 8 * round(copied * len(slots.record) / 8)
        slots.places[slots.serial & slots.mask][:size] = slots.record[:size]
        self._link.writer.close()
        self._link.writer = WritingTask(self.segment, self._is_compiled)
        self._link.writer.ports.apply_faults(self._link.active)

    def restart_reader(self) -> None:
        """Start another reader."""
        for writer in self._answers.writers.values():
            writer.close()
        self._link.reader = ReadingTask(self.segment, self._is_compiled)
        self._answers = self._open_answers()

    def forge(self, ahead: int, pid: int = STRANGER) -> None:
        """Publish in the writer's place, as another process."""
        slots = Slots(self.segment, self.segment.layout.find_mailbox(NAME))
        slots.resume_writing(build_signature(slots.box[Box.EPOCH], pid), slots.box[Box.HEAD])
        slots.publish_message(self.tick, self.tick + ahead, self.tick)

    def lose_writer(self, is_lost: bool) -> None:
        """Have the writer marked as lost, or not."""
        self.segment.get_block("writer")[Block.LOST] = self.tick + 1 if is_lost else 0

    def damage(self, back: int, bit: int) -> None:
        """Flip a bit of an earlier message, or of the head of its slot."""
        box = self.segment.layout.find_mailbox(NAME)
        serial = self.segment.get_box(NAME)[Box.HEAD] - back
        slot = self.segment.map.mailboxes[NAME] + MAILBOX_HEAD_SIZE
        slot += (serial % box.depth) * compute_slot_stride(box)
        self.segment.bytes[slot + bit // 8] ^= 1 << bit % 8

    def damage_head(self, bit: int) -> None:
        """Flip a bit of the mailbox's head."""
        self.segment.bytes[self.segment.map.mailboxes[NAME] + bit // 8] ^= 1 << bit % 8

    def state(self) -> dict[str, Any]:
        """Return all that both ends have left, but for times."""
        reader = self._link.reader.ports.readers[NAME]
        statistics = reader.statistics
        return {
            "mailboxes": [self._content(name) for name in (NAME, ANSWER)],
            "alarms": [self._link.rung(name) for name in ("writer", "reader")],
            "seen": self._link.reader.seen,
            "results": self.results,
            "reader": reader.words[: GOOD_OFFSET // 8].tolist(),
            "good": bytes(reader.good[8 * (Slot.STAMP_NS + 1) :]),
            "statistics": [getattr(statistics, name) for name in ReadStatistics.__slots__],
            "troubles": self._link.reader.ports.task.troubles,
            "traffic": [self._link.writer.ports.traffic, self._link.reader.ports.traffic],
        }

    def _content(self, name: str) -> bytes:
        """Return a mailbox, without the times at which its messages were published."""
        box = self.segment.layout.find_mailbox(name)
        stride = compute_slot_stride(box)
        start = self.segment.map.mailboxes[name]
        content = bytearray(self.segment.bytes[start : start + MAILBOX_HEAD_SIZE + stride * DEPTH])
        for at in range(DEPTH):
            stamp = MAILBOX_HEAD_SIZE + at * stride + 8 * Slot.STAMP_NS
            content[stamp : stamp + 8] = bytes(8)
        return bytes(content)

    def close(self) -> None:
        """Remove the bus."""
        for writer in self._answers.writers.values():
            writer.close()
        self._link.close()
        unlink_segment(self.segment.rack)


SLOT_BITS = 8 * (64 + Point.message_type.build_dtype(SIZES).itemsize)
STEPS = (
    st.tuples(st.just("cycle"), st.integers(1, DEPTH + 2)),
    st.tuples(st.just("write"), st.sampled_from([0, 0, 1, 6])),
    st.tuples(st.just("read")),
    st.tuples(st.just("advance"), st.integers(1, 24)),
)
EVENTS = (
    st.tuples(st.just("fault"), st.sampled_from([*FAULTS])),
    st.tuples(st.just("heal")),
    st.tuples(st.just("restart_writer"), st.sampled_from([0.0, 0.1, 0.5, 1.0])),
    st.tuples(st.just("restart_reader")),
    st.tuples(st.just("forge"), st.integers(0, 2)),
    st.tuples(st.just("lose_writer"), st.booleans()),
    st.tuples(st.just("damage"), st.integers(0, DEPTH - 1), st.integers(64, SLOT_BITS - 1)),
    st.tuples(st.just("damage_head"), st.sampled_from([0, 1, 2, 3, 5, 31, 62, 63])),
)
OPERATIONS = st.one_of(*STEPS, *STEPS, *EVENTS)
"""Calls of `End`: a method and its arguments. Damage spares the time stamp of a slot."""
PROTOCOLS = st.sampled_from(["time-slice", "double-buffer", "interrupt"])
RATES = st.sampled_from([(1, 1), (4, 1), (1, 4), (2, 3)])


def drive(
    protocol: Protocol, rates: tuple[int, int], operations: Sequence[Operation]
) -> list[tuple[Any, ...]]:
    """Do the operations on both buses, and compare them after each; return all alarms of the
    writer."""
    alarms: list[tuple[Any, ...]] = []
    ends = [End(protocol, rates, is_compiled) for is_compiled in (False, True)]
    try:
        for at, (method, *arguments) in enumerate([("cycle", 2), *operations, ("cycle", 3)]):
            for end in ends:
                getattr(end, method)(*arguments)
            python, compiled = (end.state() for end in ends)
            for part, expected in python.items():
                assert compiled[part] == expected, (at, method, arguments, part)
            alarms += python["alarms"][0]
    finally:
        for end in ends:
            end.close()
    return alarms


@pytest.mark.slow
@settings(max_examples=50)
@given(PROTOCOLS, RATES, st.lists(OPERATIONS, min_size=20, max_size=60))
def test_machine_code_leaves_every_byte_and_verdict_as_python_does(
    protocol: Protocol, rates: tuple[int, int], operations: list[Operation]
) -> None:
    drive(protocol, rates, operations)


@pytest.mark.thorough
@pytest.mark.timeout(600)
@settings(max_examples=AT_LENGTH)
@given(PROTOCOLS, RATES, st.lists(OPERATIONS, min_size=40, max_size=120))
def test_machine_code_leaves_every_byte_and_verdict_as_python_does_at_length(
    protocol: Protocol, rates: tuple[int, int], operations: list[Operation]
) -> None:
    drive(protocol, rates, operations)


@pytest.mark.parametrize("pid", [1, 2, STRANGER])
def test_an_intruder_of_any_process_id_is_reported_once_per_episode(pid: int) -> None:
    intrusion = [("advance", 1), ("forge", 0, pid), ("write", 0)]
    pause = [("advance", 1), ("write", 0)]
    episode = [*intrusion * (CLEAN_READS + 2), *pause, *intrusion]
    alarms = drive("time-slice", (1, 1), [*episode, *pause * (CLEAN_READS + 2), *episode])
    assert [(alarm[1], alarm[3]) for alarm in alarms] == [(Alarm.MASQUERADE, pid)] * 2


def test_a_message_rests_on_the_oldest_of_its_sources_that_have_come(make_bus: MakeBus) -> None:
    sources = [mailbox(name=f"{name}.point", writer=name) for name in ("one", "two", "three")]
    names = tuple(box.name for box in sources)
    box = replace(mailbox(name=ANSWER, writer="reader"), rests_on=names)
    tasks = [task(name, slot=2 + at) for at, name in enumerate(("one", "two", "three", "reader"))]
    segment = make_bus(*sources, box, *tasks)
    readers = [Reader(segment, name) for name in names]
    writer = Writer(segment, ANSWER)
    table = WriteTable([(writer, readers)])
    assert not table.write(0)
    assert writer.slots.heads[1][Slot.BASIS] == 0
    for reader, serial, basis in zip(readers, (1, 1, 0), (30, 20, 10), strict=True):
        reader.serial = serial
        reader.basis = basis
    table.write(40)
    assert writer.slots.heads[2][Slot.BASIS] == 20


def test_memory_that_is_not_aligned_to_words_is_refused() -> None:
    memory = memoryview(bytearray(64))
    assert get_address(memory[8:]) == get_address(memory) + 8
    with pytest.raises(MailboxError, match=r"^memory at 0x[0-9a-f]+ is not aligned to 8 bytes"):
        get_address(memory[4:])
