"""The physics of a recorded run alone: `mj_step` calls with the torques of the servo level.

No controller can leave out this part of a servo cycle, which makes it a baseline for the whole
cycle. The replay must end in the recorded state, bit for bit. Otherwise it did different work.
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
    """Replay the longest stretch of a run in which motors moved the arm and no cycle was missed.

    Call it through `run_in_board_environment`, because only that environment reproduces the
    physics of boards.

    Args:
        folder: Folder of the run.
        ticks: Maximum number of ticks to replay.

    Returns:
        Processor time of each tick, us.

    Raises:
        Failure: If the arm never moved, or if a complete replay does not end in the recorded state.
    """
    recording = Recording(folder)
    config = recording.rack_config
    cell = build_rack_cell(config)
    model = enable_sleep(cell.model, config.scene)
    first, last = _find_longest_motion(recording)
    status = f"{SERVO_BOARD}.status"
    command_ticks = recording.read_signal(status, "tick")
    is_in_stretch = (command_ticks >= first) & (command_ticks < last)
    controls = np.zeros((last - first, model.nu))
    controls[:, cell.actuators] = recording.read_signal(status, "torque")[is_in_stretch]
    if cell.gripper is not None:
        controls[:, cell.gripper.actuator] = recording.read_signal(status, "grip_force")[
            is_in_stretch
        ]
    data, recorded = mujoco.MjData(model), mujoco.MjData(model)
    state_ticks = recording.read_signal(f"{SERVO_BOARD}.state", "tick")
    states = recording.read_signal(f"{SERVO_BOARD}.state", "state")
    for target, tick in ((data, first), (recorded, last)):
        restore_state(model, target, states[state_ticks == tick][0])
    substeps = round(config.clock_ns * 1e-9 / model.opt.timestep)
    times_us: list[float] = []
    for number, control in enumerate(controls[:ticks], first + 1):
        data.ctrl[:] = control
        start_ns = time.thread_time_ns()
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        times_us.append((time.thread_time_ns() - start_ns) * 1e-3)
        data.time = number * config.clock_ns * 1e-9
    ends_equal = np.array_equal(data.qpos, recorded.qpos) and np.array_equal(
        data.qvel, recorded.qvel
    )
    if len(times_us) == len(controls) and not ends_equal:
        raise Failure(
            "the replayed physics do not end in the recorded state: the servo ran other physics"
        )
    return times_us


def _find_longest_motion(recording: Recording) -> tuple[int, int]:
    """Return the first and last tick of the longest stretch without brakes.

    Both are ticks at which the state of the arm was recorded.
    """
    status = f"{SERVO_BOARD}.status"
    ticks = recording.read_signal(status, "tick")[recording.read_signal(status, "braked") == 0]
    stretches = np.split(ticks, np.flatnonzero(np.diff(ticks) != 1) + 1)
    state_ticks = recording.read_signal(f"{SERVO_BOARD}.state", "tick")
    known_ticks = [np.intersect1d(stretch, state_ticks) for stretch in stretches]
    ends = [(int(stretch[0]), int(stretch[-1])) for stretch in known_ticks if len(stretch)]
    longest = max(ends, key=lambda pair: pair[1] - pair[0], default=(0, 0))
    if longest[0] == longest[1]:
        raise Failure(
            "the arm did not move in the recorded run: there is nothing to replay; run it longer"
        )
    return longest
