"""Tests the wait for a level's reply to an operator's command."""

from __future__ import annotations

from pathlib import Path

from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.words import Block
from rack.boards.config import load, resolve
from rack.tools.monitor.replies import REPLY_CYCLES, ReplyDeadline
from tests.boards.commanded_racks import COMMANDED


def test_the_wait_for_a_level_is_bounded_by_its_cycles(tmp_path: Path, rack_name: str) -> None:
    (tmp_path / "told.toml").write_text(COMMANDED)
    layout = resolve(load(tmp_path / "told.toml", [f"name={rack_name}"])).layout
    segment = Segment.create(layout, "")
    try:
        block = segment.get_block("lower")
        last = ReplyDeadline(segment, layout.find_mailbox("lower.status"))
        # It skipped ticks, but did few cycles.
        block[Block.CYCLES] = REPLY_CYCLES
        assert last.explain_missing_reply(100) == ""
        block[Block.CYCLES] += 1
        assert last.explain_missing_reply(101) == f"has not answered within {REPLY_CYCLES} cycles"
        stopped = ReplyDeadline(segment, layout.find_mailbox("lower.status"))
        assert stopped.explain_missing_reply(101) == stopped.explain_missing_reply(501) == ""
        assert (
            stopped.explain_missing_reply(502)
            == "has not answered, and has not completed a cycle since tick 101"
        )
    finally:
        unlink_segment(rack_name)
