"""The physics of a recorded run alone: bare `mj_step` calls with the torques that the servo level
gave.

They are the part of a servo cycle that no controller can leave out, so the cycle is compared with
them. The replay must end in the recorded state, bit for bit: otherwise it was other work.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from rack.boards.config.cell import built_cell
from rack.levels.robot.cell import Cell
from rack.levels.robot.state import restore_state, sleeping
from rack.tools.console.answer import Failure
from rack.tools.recording.recording import Recording

SERVO = "servo"


@dataclass(frozen=True)
class Replay:
    """The longest stretch of a recorded run in which motors, not brakes, moved the arm.

    `start` and `end` are MuJoCo's states before and after it; `controls` are the actuators' inputs
    by tick, shape (ticks, nu).
    """

    cell: Cell
    substeps: int
    clock_ns: int
    first_tick: int
    start: np.ndarray
    end: np.ndarray
    controls: np.ndarray

    @classmethod
    def of(cls, recording: Recording) -> Replay:
        """Take it from a recording without missed cycles. Raises `Failure` if the arm never moved
        in it."""
        config = recording.rack_config
        cell = built_cell(config)
        cell = replace(cell, model=sleeping(cell.model, config.scene))
        first, last = _stretch(recording)
        status = f"{SERVO}.status"
        state = f"{SERVO}.state"
        ticks = recording.signal(status, "tick")
        given = (ticks >= first) & (ticks < last)
        controls = np.zeros((last - first, cell.model.nu))
        controls[:, cell.actuators] = recording.signal(status, "torque")[given]
        if cell.gripper is not None:
            controls[:, cell.gripper.actuator] = recording.signal(status, "grip_force")[given]
        states = dict(
            zip(
                recording.signal(state, "tick").tolist(),
                recording.signal(state, "state"),
                strict=True,
            )
        )
        substeps = round(config.clock_ns * 1e-9 / cell.model.opt.timestep)
        return cls(cell, substeps, config.clock_ns, first, states[first], states[last], controls)

    def run(self, ticks: int) -> list[float]:
        """Replay at most so many ticks; return the processor time of each, us.

        Raises:
            Failure: If the whole stretch is replayed and does not end as recorded.
        """
        model = self.cell.model
        data = mujoco.MjData(model)
        restore_state(model, data, self.start)
        found: list[float] = []
        for number, control in enumerate(self.controls[:ticks], self.first_tick + 1):
            data.ctrl[:] = control
            start_ns = time.thread_time_ns()
            for _ in range(self.substeps):
                mujoco.mj_step(model, data)
            found.append((time.thread_time_ns() - start_ns) * 1e-3)
            data.time = number * self.clock_ns * 1e-9
        if len(found) == len(self.controls):
            self._check(data)
        return found

    def _check(self, data: mujoco.MjData) -> None:
        recorded = mujoco.MjData(self.cell.model)
        restore_state(self.cell.model, recorded, self.end)
        if not (
            np.array_equal(data.qpos, recorded.qpos) and np.array_equal(data.qvel, recorded.qvel)
        ):
            raise Failure(
                "the replayed physics do not end in the recorded state: they are not what the"
                " servo ran"
            )


def replay(folder: Path, ticks: int) -> list[float]:
    """Replay at most so many ticks of a recorded run; return the processor time of each, us.

    To be called by `apart`: only in the environment of boards are the physics theirs. Raises
    `Failure` as `Replay`.
    """
    return Replay.of(Recording(folder)).run(ticks)


def _stretch(recording: Recording) -> tuple[int, int]:
    """Return first and last tick of the longest stretch without brakes; states are recorded at
    both."""
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
