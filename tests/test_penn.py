"""The rack penn, with real processes in lockstep: it wipes over an edge; its client dies, and the
force is held."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from rack.boards.config import load
from rack.levels.systems.force.messages import Mode
from rack.levels.systems.trajectory.messages import RequestEnd
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack

pytestmark = pytest.mark.thorough

PRESS, EDGE, STEP = 15.0, 0.02, 0.012  # N, m, m
SCRIPT = """
import os, signal
from rack.levels.errors import LevelError

DOWN = (0.0, 0.0, 1.0, 0.0)
line((0.5, -0.02, 0.54), DOWN)
guard("touch")
line((0.5, -0.02, 0.49), DOWN, segment=1.0)
try:
    comply("wipe", wrench={"z": 1000.0})
except LevelError:
    wait(comply("wipe"))
wait(line((0.5, 0.09, 0.5), DOWN, segment=2.0))
line((0.5, 0.06, 0.5), DOWN, segment=3.0)
stay(1.0)
wait(until=lambda: where()[1] < 0.085)
os.kill(os.getpid(), signal.SIGKILL)
"""
SECONDS = 10.5
SETTINGS = (
    "clock.mode=lockstep",
    "host.coordinator.restarts=0",
    "host.coordinator.params.script=press.py",
    "board.bridge.ends_run=false",
    "board.server.params.silence=1.0",
    "board.server.params.hold=0.4",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("penn")
    (folder / "press.py").write_text(SCRIPT)
    settings = [f"name=test-penn-{os.getpid()}", f'python_path=["{folder}"]', *SETTINGS]
    result = run_rack(load("penn", settings), SECONDS, folder / "run", Display())
    assert result.recording == "complete"
    return folder / "run"


def table(run: Path, mailbox: str, *fields: str) -> list[np.ndarray]:
    """Return the columns of a mailbox: seconds, then `fields`."""
    names = ["tick", *fields]
    rows = pq.read_table(run / "signals" / f"{mailbox}.parquet", columns=names)
    time_s, *values = [np.array(rows[name].to_pylist()) for name in names]
    return [time_s * 1e-3, *values]


@pytest.mark.slow
def test_the_force_is_kept_on_the_flat_and_after_an_edge_that_nobody_knows(run: Path) -> None:
    _, place, wrench, mode, current = table(
        run, "server.status", "place", "wrench", "mode", "current"
    )
    wiping = (mode == Mode.FORCE) & (current == 5)
    y, pressed = place[wiping, 1], wrench[wiping, 2]
    before, after = pressed[(y > -0.01) & (y < EDGE - 0.005)], pressed[y > EDGE + 0.05]
    assert min(len(before), len(after)) > 10
    assert np.abs(before - PRESS).max() < 2.0
    assert np.abs(after - PRESS).max() < 2.0
    assert place[wiping][0, 2] - place[wiping][-1, 2] == pytest.approx(STEP, abs=1e-3)
    # The pad rolls off the edge, and is back on the surface within its width.
    off = y[np.abs(pressed - PRESS) > 5.0]
    assert len(off)
    assert EDGE - 0.005 < off.min() < off.max() < EDGE + 0.05


@pytest.mark.slow
def test_a_lost_client_leaves_its_segment_ended_and_the_force_held_and_then_released(
    run: Path,
) -> None:
    time_s, wrench, mode, resting, ended, ends, place, reason = table(
        run, "server.status", "wrench", "mode", "resting", "ended", "ends", "place", "reason"
    )
    held, released = mode == Mode.HELD, mode == Mode.RELEASED
    assert np.ptp(time_s[held]) == pytest.approx(0.4, abs=0.03)
    assert np.abs(wrench[held, 2] - PRESS).max() < 2.0
    assert resting[held][-1]
    assert ends[-1][ended[-1] == 6].item() == RequestEnd.CANCELLED
    assert np.abs(wrench[released, 2])[-1] < 0.5  # five times the sensor's noise
    assert np.abs(np.diff(place[released], axis=0)).max() < 1e-3
    assert b"forces released, the position is held" in reason[-1].encode()


@pytest.mark.slow
def test_no_limit_is_exceeded_and_no_torque_steps(run: Path) -> None:
    _, violations, touches, target = table(run, "arm.status", "violations", "touches", "target")
    assert violations[-1] == touches[-1] == 0
    assert np.abs(np.diff(target[10:], 2, axis=0)).max() * 1e6 < 2.0 * 12.0
