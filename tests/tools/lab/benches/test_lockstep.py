"""The bench of lockstep: the levels alone do the work of a rack, bit for bit, and speeds follow
from given times."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.boards import OneProcess
from rack.boards.config import RackConfig, load
from rack.tools.lab.benches.apart import run_in_board_environment
from rack.tools.lab.benches.harness import Sample
from rack.tools.lab.benches.lockstep import WITHOUT_RACK, build_comparison, run_bare
from rack.tools.recording.recording import Recording

pytestmark = pytest.mark.thorough


def test_levels_write_the_same_messages_with_and_without_a_rack(nasrem: Recording) -> None:
    ticks = nasrem.end_counts["outcome"]["ticks"]
    newest = run_in_board_environment(read_newest, load("nasrem", ["clock.mode=lockstep"]), ticks)
    for name in nasrem.mailboxes:
        rows = nasrem.read_rows(name)["message"]
        (visible,) = np.nonzero(nasrem.read_signal(name, "visible_at") < ticks)
        assert newest.get(name) == (rows[visible[-1]] if len(visible) else None), name


def read_newest(config: RackConfig, ticks: int) -> dict[str, Any]:
    """Run the levels in one process, and return the newest message of each mailbox."""
    with OneProcess(config) as rack:
        rack.run_ticks(ticks)
        return {name: rack.newest(name).record[()].copy() for name in rack.serials}


def test_the_time_of_bare_levels_is_processor_time_in_seconds(small: Path) -> None:
    config = load(small, ["clock.mode=lockstep"])
    start_s = time.process_time()
    assert 0.0 < run_bare(config, 40) < time.process_time() - start_s


def test_speeds_follow_from_times_and_the_ratios_from_the_baseline() -> None:
    times = {"this tree": (200.0, 240.0, 250.0), "base": (500.0,), WITHOUT_RACK: (160.0,)}
    samples = [Sample("nasrem", who, values, "ms") for who, values in times.items()]
    ratios = {"base": [0.48, 1.0, 0.32], WITHOUT_RACK: [1.5, 3.125, 1.0]}
    for baseline, expected in ratios.items():
        found = build_comparison(samples, baseline)
        assert [found.compute_ratio(sample) for sample in samples] == expected
        assert list(found.format_blocks())[-1] == (
            "simulated seconds a second:"
            " nasrem 4.17 (this tree), nasrem 2 (base), nasrem 6.25 (no rack)"
        )
