"""The physics of a recorded run alone: `mj_step` calls with the torques of the servo level.

No controller can leave out this part of a servo cycle, which makes it a baseline for the whole
cycle. Each tick must end in the recorded state, bit for bit. Otherwise it did different work.
"""

from __future__ import annotations

import time
from pathlib import Path

import mujoco
import numpy as np

from rack.boards.config.cell import build_rack_cell
from rack.levels.arm.simulation import enable_sleep, restore_state
from rack.tools.console.answer import Failure
from rack.tools.recording.recording import Recording

SERVO_BOARD = "servo"


def replay_physics(folder: Path, ticks: int) -> list[float]:
    """Replay the ticks of a run in which motors moved the arm, each from its recorded state.

    Call it through `run_in_board_environment`, because only that environment reproduces the
    physics of boards.

    Args:
        folder: Folder of the run.
        ticks: Maximum number of ticks to replay.

    Returns:
        Processor time of each tick, us.

    Raises:
        Failure: If the arm never moved, or if a tick does not end in the recorded state.
    """
    recording = Recording(folder)
    config = recording.rack_config
    cell = build_rack_cell(config)
    model = enable_sleep(cell.model, config.scene)
    data = mujoco.MjData(model)
    status_ticks, braked, torque, grip_force = (
        recording.read_signal(f"{SERVO_BOARD}.status", name)
        for name in ("tick", "braked", "torque", "grip_force")
    )
    controls = np.zeros((len(torque), model.nu))
    controls[:, cell.actuators] = torque
    if cell.gripper is not None:
        controls[:, cell.gripper.actuator] = grip_force
    is_driven = braked == 0
    control_by_tick = dict(zip(status_ticks[is_driven].tolist(), controls[is_driven], strict=True))
    state_ticks, states = (
        recording.read_signal(f"{SERVO_BOARD}.state", name) for name in ("tick", "state")
    )
    starts = np.flatnonzero(np.diff(state_ticks) == 1)
    replayed = [row for row in starts if state_ticks[row] in control_by_tick][:ticks]
    substeps = round(config.clock_ns * 1e-9 / model.opt.timestep)
    times_us: list[float] = []
    for row in replayed:
        restore_state(model, data, states[row])
        data.ctrl[:] = control_by_tick[state_ticks[row]]
        start_ns = time.thread_time_ns()
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        times_us.append((time.thread_time_ns() - start_ns) * 1e-3)
        # A state begins with the time, the positions and the velocities.
        if not np.array_equal(
            states[row + 1][1 : 1 + model.nq + model.nv], [*data.qpos, *data.qvel]
        ):
            raise Failure(
                "the replayed physics do not end in the recorded state: the servo ran other physics"
            )
    if not times_us:
        raise Failure(
            "the arm did not move in the recorded run: there is nothing to replay; run it longer"
        )
    return times_us
