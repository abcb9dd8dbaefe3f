"""The bench of cycles: real racks in a short form, the parts of given traces, and the physics of a
recorded run."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.trace import RECORD
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.apart import apart
from rack.tools.lab.benches.cycle import PACED, PARTS, ROW, Found, Trace, costs, measure, parts_of
from rack.tools.lab.benches.physics import Replay, ReplayPace, replay
from rack.tools.recording.recording import Recording
from tests.shared_runs import nasrem_run

pytestmark = pytest.mark.thorough


def trace(processor_us: int, cycles: int = 5) -> Trace:
    """Return cycles with 1 us of exchange, 2 of reading, 30 of processing and 4 of writing."""
    rows = np.zeros(cycles, RECORD)
    rows["tick"] = np.arange(cycles)
    rows["processor_ns"] = processor_us * 1000
    return Trace(rows, np.tile(np.array([1000, 2000, 30000, 4000]), (cycles, 1)))


def test_the_parts_of_a_cycle_are_its_whole_processor_time() -> None:
    one = trace(50)
    one.rows["end_ns"] = one.rows["tick"] * 2_500_000
    one.rows["closed_ns"][1:] = one.rows["end_ns"][:-1] + 5000
    found = parts_of(one)
    assert tuple(found) == PARTS
    assert [times.tolist() for times in found.values()] == [
        [us] * 4 for us in (8.0, 3.0, 30.0, 4.0, 5.0)
    ]


def test_bookkeeping_that_a_trace_does_not_separate_is_part_of_waking_up() -> None:
    assert [times[0] for times in parts_of(trace(50)).values()] == [13.0, 3.0, 30.0, 4.0, 0.0]


def test_interrupted_bookkeeping_counts_without_the_interruption() -> None:
    one = trace(50)
    one.rows["end_ns"] = one.rows["tick"] * 2_500_000
    one.rows["closed_ns"][1:] = one.rows["end_ns"][:-1] + 90_000
    one.rows["start_ns"][1:] = one.rows["closed_ns"][1:] + 2000
    assert [times[0] for times in parts_of(one).values()] == [2.0, 3.0, 30.0, 4.0, 11.0]


def given(**others: Trace) -> Found:
    found = Found(defaultdict(list), defaultdict(list))
    found.traces["servo, real time", "this tree"] = [trace(50), trace(50), trace(200)]
    for who, one in others.items():
        found.traces["servo, real time", who] = [one]
    found.physics_us[ROW], found.physics_us[PACED] = [np.array([20.0])], [np.array([25.0])]
    return found


def test_a_board_is_compared_with_another_checkout_and_the_servo_with_its_physics() -> None:
    found = costs(given(base=trace(100)), "base").comparison
    own = found.sample("servo, real time", "this tree")
    physics = found.sample("servo and its physics, real time", "this tree")
    assert own is not None
    assert physics is not None
    assert (own.median, own.count, found.ratio(own), found.ratio(physics)) == (50.0, 15, 0.5, 2.0)
    bare = found.sample("servo and its physics, real time", ROW)
    assert bare is not None
    assert found.ratio(bare) == 0.8


def test_without_another_checkout_only_physics_give_a_ratio() -> None:
    found = costs(given(), None).comparison
    assert {sample.case for sample in found.samples if found.ratio(sample)} == {
        "servo and its physics, real time"
    }


def test_a_single_cycle_has_no_parts_and_is_not_drawn(tmp_path: Path) -> None:
    found = given()
    found.traces["task, real time", "this tree"] = [trace(50, cycles=1)]
    bench = costs(found, None)
    assert [one.case for one in bench.parts] == ["servo, real time"]
    assert bench.comparison.sample("task, real time", "this tree") is not None
    assert all(path.stat().st_size for path in bench.plot(tmp_path))


@pytest.mark.slow
def test_a_short_bench_measures_every_board_of_real_racks(tmp_path: Path) -> None:
    found = measure(None, 0.6, 1, Progress(), share=True)
    document = found.document()
    assert json.loads(json.dumps(document)) == document
    boards = ("empty", "servo", "primitive", "elemental_move", "task", "world")
    # In so short a run the task level has no cycle beyond those that a new process spends warming
    # up.
    seen = {one.case for one in found.parts}
    assert seen == {
        f"{board}, {mode}"
        for board in boards
        if board != "task"
        for mode in ("real time", "lockstep")
    }
    for one in found.parts:
        sample = found.comparison.sample(one.case, one.who)
        assert sample is not None
        assert set(one.parts) == set(PARTS)
        assert min(one.parts.values()) >= 0.0
        assert sample.median > one.parts["process"]
    assert {"servo and its physics, lockstep", "servo and its physics, real time"} <= set(
        found.comparison.baselines
    )
    assert [path.name for path in found.plot(tmp_path)] == ["cycle.png", "cycle.svg"]
    assert any("servo and its physics" in line for line in found.lines(100))


@pytest.mark.slow
def test_replayed_physics_end_in_the_recorded_state(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    run = nasrem_run(tmp_path_factory)
    whole = len(Replay.of(Recording(run)).controls)
    assert whole > 1000
    times_us = apart(replay, run, ReplayPace(), whole)
    assert len(times_us) == whole
    assert min(times_us) > 0.0


@pytest.mark.slow
def test_physics_of_another_run_are_refused(tmp_path_factory: pytest.TempPathFactory) -> None:
    own = Replay.of(Recording(nasrem_run(tmp_path_factory)))
    short = replace(own, controls=own.controls[:20])
    with pytest.raises(Failure, match="do not end in the recorded state"):
        short.run(ReplayPace(), 20)
