"""A recorded rack: its counters give the number of cycles, and its trace the lateness."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.boards.config import load_text
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.observed import compute_lateness_us, count_cycles, record_rack
from tests.tools.recordings import Cycle, recorded


def test_a_board_that_overslept_grid_points_is_late_from_the_first_of_them(tmp_path: Path) -> None:
    config, parts = load_text(Chain(1, 400).format_config()), (0.0, 0.1, 0.1, 0.1)
    overslept = int(Flag.SKIPPED) | 2 << SKIPPED_SHIFT
    trace = [Cycle(0, parts, 0.1), Cycle(200, parts, 0.1), Cycle(203, parts, 0.1, flags=overslept)]
    recording = recorded(tmp_path / "run", config, {"board1": trace})
    # The start of the run does not count.
    assert compute_lateness_us(recording, "board1").tolist() == [100.0, 5100.0]


@pytest.mark.thorough
def test_a_chain_passes_a_message_on_in_every_cycle(tmp_path: Path) -> None:
    chain = Chain(2, 400, "lockstep")
    result, recording = record_rack(load_text(chain.format_config()), 0.1, tmp_path / "run")
    assert result.outcome.ticks == 40
    assert count_cycles(result.tasks[name] for name in chain.names) == (0, 80)
    assert recording.read_signal("board2.status", "sent").tolist() == [-1, *range(39)]
