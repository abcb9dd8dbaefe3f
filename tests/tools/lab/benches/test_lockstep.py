"""The bench of lockstep: the levels alone do the work of a rack, bit for bit, and speeds follow
from given times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rack.boards.config import load
from rack.tools.lab.benches.apart import run_in_board_environment
from rack.tools.lab.benches.harness import Sample
from rack.tools.lab.benches.lockstep import (
    WITHOUT_RACK,
    build_comparison,
    find_differences,
    run_bare,
)
from rack.tools.recording.recording import Recording
from tests.shared_runs import nasrem_run

pytestmark = pytest.mark.thorough


@pytest.mark.slow
def test_levels_write_the_same_messages_with_and_without_a_rack(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    recording = Recording(nasrem_run(tmp_path_factory))
    config = load("nasrem", ["clock.mode=lockstep"])
    bare = run_in_board_environment(run_bare, config, recording.end_counts["outcome"]["ticks"])
    assert list(find_differences(recording, bare)) == []
    assert bare.processor_s > 0.0
    # Other work is noticed: one message less, or one value that differs in its last bit.
    fewer = replace(bare, serials={**bare.serials, "servo.plan": bare.serials["servo.plan"] - 1})
    assert list(find_differences(recording, fewer)) == ["the number of messages in servo.plan"]
    status = bare.last["servo.status"].copy()
    status["position"][0] = np.nextafter(status["position"][0], 10.0)
    other = replace(bare, last={**bare.last, "servo.status": status})
    assert list(find_differences(recording, other)) == ["servo.status, field position"]


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
