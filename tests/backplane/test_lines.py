"""Utility lines: SYSFAIL by slot, and the lines of one word each."""

from __future__ import annotations

import pytest

from rack.backplane.errors import EmergencyStopError
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus


@pytest.fixture
def bus(make_bus: MakeBus) -> Segment:
    return make_bus(task("low", slot=21), task("high", slot=2), task("high.planner", slot=2))


def test_a_board_holds_sysfail_until_its_self_test_has_passed_and_when_it_fails(
    bus: Segment,
) -> None:
    lines = UtilityLines(bus)
    assert lines.sysfail == [2, 21]
    lines.release_sysfail(2)
    assert UtilityLines(Segment.attach(bus.rack)).sysfail == [21]
    lines.release_sysfail(21)
    assert lines.sysfail == []
    lines.assert_sysfail(21)
    assert lines.sysfail == [21]


@pytest.mark.parametrize("line", ["acfail", "sysreset", "emergency_stop"])
def test_each_line_has_a_separate_word(bus: Segment, line: str) -> None:
    lines, names = UtilityLines(bus), ("acfail", "sysreset", "emergency_stop")
    bus.words[getattr(System, line.upper())] = 1
    assert [name for name in names if getattr(lines, name)] == [line]


def test_the_emergency_stop_latches_until_every_input_is_good(bus: Segment) -> None:
    lines = UtilityLines(bus)
    lines.latch_emergency_stop()
    lines.release_sysfail(2)
    bus.words[System.ACFAIL] = 1
    bus.get_block("high")[Block.LOST] = 1
    message = "stays latched: SYSFAIL of slot 21, ACFAIL, board 'high' is lost$"
    with pytest.raises(EmergencyStopError, match=message):
        lines.reset_emergency_stop()
    assert lines.emergency_stop
    lines.release_sysfail(21)
    bus.words[System.ACFAIL] = bus.get_block("high")[Block.LOST] = 0
    lines.reset_emergency_stop()
    assert not lines.emergency_stop
