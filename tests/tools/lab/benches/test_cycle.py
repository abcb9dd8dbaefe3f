"""The bench of cycles: parts of given traces, comparisons, and the physics of a recorded run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from rack.backplane.trace import RECORD
from rack.boards.config import load, resolve_layout
from rack.levels.arm.simulation import enable_sleep
from rack.tools.console.answer import Failure
from rack.tools.lab.benches import physics
from rack.tools.lab.benches.apart import run_in_board_environment
from rack.tools.lab.benches.cycle import PARTS, PHYSICS, compute_costs, compute_parts
from rack.tools.lab.benches.physics import replay_physics
from rack.tools.recording.cycles import Cycles
from rack.tools.recording.recording import Recording

pytestmark = pytest.mark.thorough


WHOLE = 1_000_000
"""More ticks than any run has."""
TASK = resolve_layout(load("nasrem")).find_task("servo")


def cycles(processor_us: int, count: int = 5) -> Cycles:
    """Return cycles with 1 us of exchange, 2 of reading, 30 of processing and 4 of writing."""
    rows = np.zeros(count, RECORD)
    rows["tick"] = np.arange(count)
    rows["processor_ns"] = processor_us * 1000
    rows["end_ns"] = rows["tick"] * 2_500_000
    rows["closed_ns"][1:] = rows["end_ns"][:-1] + 5000
    parts = np.tile(np.array([1000, 2000, 30000, 4000]), (count, 1))
    return Cycles(TASK, 0, 0, rows, *parts.T, np.ones(count, bool), 0)


def test_the_parts_of_a_cycle_are_its_whole_processor_time() -> None:
    found = compute_parts(cycles(50))
    assert tuple(found) == PARTS
    assert [set(times) for times in found.values()] == [{8.0}, {3.0}, {30.0}, {4.0}, {5.0}]
    # Interrupted bookkeeping counts without the interruption.
    one = cycles(50)
    one.rows["closed_ns"][1:] = one.rows["end_ns"][:-1] + 90_000
    one.rows["start_ns"][1:] = one.rows["closed_ns"][1:] + 2000
    assert [times[0] for times in compute_parts(one).values()] == [2.0, 3.0, 30.0, 4.0, 11.0]
    # Start-up and stalls are not judged.
    one.is_judged[[0, 3]] = False
    assert len(compute_parts(one)["process"]) == 3


THIS_TREE = {("servo, lockstep", "this tree"): [cycles(50), cycles(50), cycles(200)]}


def test_a_board_is_compared_with_another_checkout_or_the_servo_with_its_physics() -> None:
    both = compute_costs({**THIS_TREE, ("servo, lockstep", "base"): [cycles(100)]}, [20.0], "base")
    alone = compute_costs(THIS_TREE, [20.0], None)
    for found, ratio in ((both, 0.5), (alone, 2.5)):
        own = found.find_sample("servo, lockstep", "this tree")
        assert own is not None
        assert (own.median, own.count, found.compute_ratio(own)) == (50.0, 15, ratio)
        assert found.find_sample("servo, lockstep", PHYSICS) is not None


def test_replayed_physics_end_in_the_recorded_state(nasrem: Recording) -> None:
    times_us = run_in_board_environment(replay_physics, nasrem.folder, WHOLE)
    assert 1000 < len(times_us) < WHOLE
    assert min(times_us) > 0.0


def test_physics_of_another_run_are_refused(nasrem: Recording) -> None:
    with pytest.raises(Failure, match="do not end in the recorded state"):
        run_in_board_environment(replay_lighter, nasrem.folder, WHOLE)


def replay_lighter(run: Path, ticks: int) -> list[float]:
    """Replay a run with a little less gravity."""

    def lighter(*arguments: Any) -> mujoco.MjModel:
        model = enable_sleep(*arguments)
        model.opt.gravity[2] *= 0.999
        return model

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(physics, "enable_sleep", lighter)
        return replay_physics(run, ticks)
