"""Tests the wait for a level's reply to an operator's command."""

from __future__ import annotations

from pathlib import Path

from rack.backplane.words import Block
from rack.boards.config import load
from rack.tools.monitor.replies import REPLY_CYCLES, ReplyDeadline
from tests.tools.conftest import MakeSegment


def test_the_wait_for_a_level_is_bounded_by_its_cycles(
    commanded: Path, rack_name: str, make_segment: MakeSegment
) -> None:
    segment = make_segment(load(commanded, [f"name={rack_name}"]))
    block, mailbox = segment.get_block("lower"), segment.layout.find_mailbox("lower.status")
    last = ReplyDeadline(segment, mailbox)
    # It skipped ticks, but did few cycles.
    block[Block.CYCLES] = REPLY_CYCLES
    assert last.explain_missing_reply(100) == ""
    block[Block.CYCLES] += 1
    assert last.explain_missing_reply(101) == f"has not answered within {REPLY_CYCLES} cycles"
    stopped = ReplyDeadline(segment, mailbox)
    assert stopped.explain_missing_reply(101) == stopped.explain_missing_reply(501) == ""
    why = "has not answered, and has not completed a cycle since tick 101"
    assert stopped.explain_missing_reply(502) == why
