"""The viewer's file of a long run is written in parts, so that the library frees memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import RackConfig
from rack.tools.recording.spool import open_rings
from rack.tools.viewer import sink
from rack.tools.viewer.reading import read_component
from rack.tools.viewer.sink import ViewSink
from rack.tools.viewer.window import find_executable
from tests.processes import BOUND_S, run_to_end

TICKS = 600
"""1.5 s: the rings hold two."""
BLOCK, PART = 40, 200


@pytest.mark.slow
def test_a_long_run_is_in_parts_that_are_finished_one_by_one(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sink, "BLOCK_S", BLOCK * 2.5e-3)
    monkeypatch.setattr(sink, "PART_S", PART * 2.5e-3)
    with Rack(config) as rack:
        view = ViewSink(rack.segment, tmp_path, None)
        rack.run(TICKS * 2.5e-3)
        taken = {name: ring.read_new_rows().rows for name, ring in open_rings(rack.segment).items()}
        for end in range(BLOCK, TICKS + 1, BLOCK):
            for name, rows in taken.items():
                view.add(name, rows[(rows["tick"] >= end - BLOCK) & (rows["tick"] < end)])
            view.advance(end, {})
            parts = [tmp_path / name for name in ("run.rrd", "run-2.rrd", "run-3.rrd", "run-4.rrd")]
            assert [part.exists() for part in parts] == [end > place * PART for place in range(4)]
            # A part is complete as soon as the next one has begun.
            if end > PART and end % PART == BLOCK:
                part = parts[end // PART - 1]
                run_to_end([find_executable(), "rrd", "verify", part], BOUND_S, check=True)
        view.close(TICKS, {})
    whole, *later = [
        read_component(part, "/signals/lower.status/count").ticks for part in parts[:3]
    ]
    assert [len(ticks) for ticks in later] == [PART] * 2
    # A reader of the first part continues in the others.
    assert np.array_equal(whole, np.arange(TICKS))
