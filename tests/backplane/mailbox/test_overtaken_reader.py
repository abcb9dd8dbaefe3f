"""A reader that is preempted anywhere while its writer laps the ring: it must not report a fault.

The reader is stopped before each single instruction of a read in turn, as the kernel may stop it,
and the writer goes on meanwhile, up to the middle of a message.
"""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

import pytest

import rack.backplane
from rack.backplane.layout import Protocol
from rack.backplane.mailbox.slots import Slots
from rack.backplane.watch.alarms import Alarm
from tests.backplane.bus import NAME
from tests.link import Link, MakeLink

pytestmark = pytest.mark.slow

DEPTH = 8
READ_EVERY = 3
LEAST = 300
"""Least number of instructions at which a reader is overtaken: one that finds nothing new has
fewer."""
CODE = next(iter(rack.backplane.__path__))
FAULTS = {
    "": set(),
    "drop": {Alarm.GAP},
    "corrupt": {Alarm.DAMAGED},
    "delay": {Alarm.HELD_BACK},
    "reorder": {Alarm.DISORDER, Alarm.HELD_BACK},
}
"""Kinds of fault, and the alarms that a reader may raise for each."""


class Overtaken:
    """A link whose writer overtakes its reader in the middle of a read."""

    def __init__(self, rack: Link) -> None:
        self.rack, self.tick = rack, 0
        self._slots = Slots(rack.segment, rack.segment.layout.find_mailbox(NAME))

    def write(self, cycles: int) -> None:
        for _ in range(cycles):
            self.rack.writer.cycle(self.tick)
            self.tick += 1

    def read(self) -> None:
        self.rack.reader.cycle(self.tick - self.tick % READ_EVERY)

    def is_overtaken(self, at: int, cycles: int, stops_halfway: bool) -> bool:
        """Read, and run the writer's cycles before that instruction of `backplane`; False if the
        read has fewer instructions."""
        left = at

        def trace(frame: FrameType, event: str, _: object) -> Any:
            nonlocal left
            if not frame.f_code.co_filename.startswith(CODE):
                return None
            frame.f_trace_opcodes, frame.f_trace_lines = True, False
            if event == "opcode":
                left -= 1
                if left == -1:
                    # The writer's code is not counted: tracing is off here.
                    self.write(cycles)
                    if stops_halfway:
                        self._write_half()
            return trace

        before = sys.gettrace()
        sys.settrace(trace)
        try:
            self.read()
        finally:
            sys.settrace(before)
        return left < 0

    def _write_half(self) -> None:
        """Leave the writer in the middle of the copy of one more message into its slot."""
        serial = self._slots.box[0] + 1
        self._slots.fetch_message(serial - 1)
        half = len(self._slots.record) // 2
        self._slots.places[serial % DEPTH][:half] = self._slots.record[:half]


@pytest.mark.parametrize(
    "protocol", ["time-slice", pytest.param("double-buffer", marks=pytest.mark.thorough)]
)
@pytest.mark.parametrize("kind", FAULTS)
def test_a_reader_overtaken_at_any_instruction_reports_nothing_false(
    link: MakeLink, protocol: Protocol, kind: str
) -> None:
    rack = link(protocol, rates=(1, READ_EVERY), depth=DEPTH, is_compiled=False)
    reader, rung, at = Overtaken(rack), set(), 0
    reader.write(DEPTH)
    reader.read()
    if kind:
        rack.fault(kind, *([0.5] if kind != "delay" else []))
    # A message that is dropped is not in the middle of its copy.
    while reader.is_overtaken(at, DEPTH - 2 + at % (DEPTH + 4), kind != "drop") or at < LEAST:
        at += 7 if kind else 2
        reader.write(READ_EVERY)
        reader.read()
        reader.write(READ_EVERY)
        rung |= {code for _, code in rack.alarms()}
    assert rung <= FAULTS[kind]
