"""Static cyclic schedules: the places of boards in their frames, and boards that do not fit in
them."""

from __future__ import annotations

from rack.boards.config import load, resolve_layout
from rack.boards.config.timing import build_rack_timing
from rack.boards.timing.frames import CoreFrames, compute_core_frames
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.verdicts import FRAMES, evaluate_rack

MS = 1_000_000


def timing(*settings: str) -> RackTiming:
    config = load("cyclic", settings)
    return build_rack_timing(config, resolve_layout(config))


def places(found: CoreFrames) -> list[tuple[str, float, float, str]]:
    """Return board, offset, slack (ms) and next board of every place."""
    return [(p.board, p.offset_ns / MS, round(p.slack_ns / MS, 6), p.until) for p in found.places]


def test_boards_released_in_one_tick_follow_each_other_by_priority() -> None:
    even, _ = compute_core_frames(timing("board.even.phase=0"))
    assert places(even) == [("fast", 0, 0, "even"), ("even", 0.94, 0.22, "")]


def test_a_board_still_running_when_the_next_begins_has_negative_slack_and_fails() -> None:
    rack = timing("board.fast.budget.process_ms=1.1")
    even, odd = compute_core_frames(rack)
    assert places(even)[0] == (*places(odd)[0][:3], "even") == ("fast", 0, -0.14, "even")
    failing = [v for v in evaluate_rack(rack) if v.equation == FRAMES and not v.holds]
    assert {(v.subject, v.left, v.right) for v in failing} == {("fast", 1.14 * MS, 1.0 * MS)}
    assert [v.meaning for v in failing] == [
        "done before 'even' begins, in frame 0",
        "done before 'odd' begins, in frame 1",
    ]


def test_a_board_longer_than_its_frame_fails_by_its_remaining_work() -> None:
    even, odd = compute_core_frames(timing("board.even.budget.process_ms=3.2"))
    assert places(even)[1] == ("even", 1, -0.24, "")
    # What it takes of the next frame is missing there: 'odd' waits for it.
    assert places(odd)[1][2] == -0.02
