"""The ticks of a recorded run."""

from __future__ import annotations

import pytest

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.tools.recording.divergence import find_tick_range
from tests.tools.conftest import Record
from tests.tools.recordings import Cycle

PARTS = (0.0, 0.1, 1.0, 0.1)


@pytest.mark.parametrize(("skipped", "begins"), [(12, 0), (0, 12)], ids=["late clock", "recorder"])
def test_a_run_begins_at_the_first_release_of_which_its_cycles_know(
    record: Record, skipped: int, begins: int
) -> None:
    flags = skipped << SKIPPED_SHIFT | int(Flag.SKIPPED) * bool(skipped)
    cycles = [Cycle(12, PARTS, flags=flags), Cycle(13, PARTS)]
    run = record({"lower": cycles, "upper": [Cycle(16, PARTS)]})
    assert find_tick_range(run) == (begins, 17)
