"""The physics of a recorded run alone: bare `mj_step` calls with the torques that the servo level
gave.

They are the part of a servo cycle that no controller can leave out, so the cycle is compared with
them. The replay must end in the recorded state, bit for bit: otherwise it was other work.
"""

from __future__ import annotations

import time
from pathlib import Path

import mujoco
import numpy as np

from rack.boards.config.cell import built_cell
from rack.levels.arm.simulation import restore_state, sleeping
from rack.tools.console.answer import Failure
from rack.tools.recording.recording import Recording

SERVO = "servo"


def replay(folder: Path, ticks: int) -> list[float]:
    """Replay the longest stretch of a recorded run, without missed cycles, in which motors, not
    brakes, moved the arm.

    To be called by `apart`: only in the environment of boards are the physics theirs.

    Args:
        folder: Folder of the run.
        ticks: Ticks to replay, at most.

    Returns:
        Processor time of each tick, us.

    Raises:
        Failure: If the arm never moved, or the whole stretch is replayed and does not end in the
            recorded state.
    """
    recording = Recording(folder)
    config = recording.rack_config
    cell = built_cell(config)
    model = sleeping(cell.model, config.scene)
    first, last = _stretch(recording)
    status = f"{SERVO}.status"
    given = recording.signal(status, "tick")
    in_stretch = (given >= first) & (given < last)
    controls = np.zeros((last - first, model.nu))
    controls[:, cell.actuators] = recording.signal(status, "torque")[in_stretch]
    if cell.gripper is not None:
        controls[:, cell.gripper.actuator] = recording.signal(status, "grip_force")[in_stretch]
    data, recorded = mujoco.MjData(model), mujoco.MjData(model)
    recorded_at = recording.signal(f"{SERVO}.state", "tick")
    states = recording.signal(f"{SERVO}.state", "state")
    for each, tick in ((data, first), (recorded, last)):
        restore_state(model, each, states[recorded_at == tick][0])
    substeps = round(config.clock_ns * 1e-9 / model.opt.timestep)
    found: list[float] = []
    for number, control in enumerate(controls[:ticks], first + 1):
        data.ctrl[:] = control
        start_ns = time.thread_time_ns()
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        found.append((time.thread_time_ns() - start_ns) * 1e-3)
        data.time = number * config.clock_ns * 1e-9
    ends_alike = np.array_equal(data.qpos, recorded.qpos) and np.array_equal(
        data.qvel, recorded.qvel
    )
    if len(found) == len(controls) and not ends_alike:
        raise Failure(
            "the replayed physics do not end in the recorded state: they are not what the servo ran"
        )
    return found


def _stretch(recording: Recording) -> tuple[int, int]:
    """Return first and last tick of the longest stretch without brakes; states are recorded at
    both.
    """
    status = f"{SERVO}.status"
    ticks = recording.signal(status, "tick")[recording.signal(status, "braked") == 0]
    stretches = np.split(ticks, np.flatnonzero(np.diff(ticks) != 1) + 1)
    recorded = recording.signal(f"{SERVO}.state", "tick")
    known = [np.intersect1d(stretch, recorded) for stretch in stretches]
    ends = [(int(stretch[0]), int(stretch[-1])) for stretch in known if len(stretch)]
    best = max(ends, key=lambda pair: pair[1] - pair[0], default=(0, 0))
    if best[0] == best[1]:
        raise Failure(
            "the arm did not move in the recorded run: no physics to replay; run it for longer"
        )
    return best
