"""A recorded rack: its counters give the number of cycles, and its trace the lateness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.backplane.trace import RECORD, SKIPPED_SHIFT, Flag
from rack.boards.config import load_text, resolve_layout
from rack.tools.lab.benches.chain import Chain
from rack.tools.lab.benches.observed import compute_lateness_us, count_cycles, record_rack
from rack.tools.recording.recording import Recording

LAYOUT = resolve_layout(load_text(Chain(1, 400).format_config()))


class Overslept(Recording):
    """Recording of three cycles, the last of which overslept two releases."""

    layout = LAYOUT

    def __init__(self) -> None:
        pass

    def read_trace(self, task: str) -> np.ndarray:
        rows = np.zeros(3, RECORD)
        rows["release_ns"] = np.array([0, 200, 203]) * LAYOUT.clock_ns
        rows["start_ns"] = rows["release_ns"] + 100_000
        rows["flags"][2] = Flag.SKIPPED | 2 << SKIPPED_SHIFT
        return rows


def test_a_board_that_overslept_grid_points_is_late_from_the_first_of_them() -> None:
    # The start of the run does not count.
    assert compute_lateness_us(Overslept(), "board1").tolist() == [100.0, 5100.0]


@pytest.mark.thorough
@pytest.mark.slow
def test_a_chain_passes_a_message_on_in_every_cycle(tmp_path: Path) -> None:
    chain = Chain(2, 400, "lockstep")
    result, recording = record_rack(load_text(chain.format_config()), 0.1, tmp_path / "run")
    assert result.outcome.ticks == 40
    assert count_cycles(result.tasks[name] for name in chain.names) == (0, 80)
    assert recording.read_signal("board2.status", "sent").tolist() == [-1, *range(39)]
