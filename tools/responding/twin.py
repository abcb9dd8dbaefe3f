"""Whether the serials tell the truth: a run, and its twin in which one command was never given.

Up to the tick at which the torque comes to rest on that command the two are equal bit for bit. From a hold given while
the arm moves they differ at that very tick, if the serials are right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rack.boards.config.schema import RackConfig
from rack.boards.operating.config import CommandConfig
from rack.tools.responding.response import Answered, Response
from rack.tools.responding.trial import run
from rack.tools.runs.recording import Recording

BEHIND_TICKS = 40
"""Ticks behind the predicted one up to which the twin runs."""
MOVING_RAD_S = 0.02


@dataclass(frozen=True)
class Twin:
    """One command, and the first tick at which the torque of the run without it differs in any bit; None: at none."""

    serial: int
    level: str
    given: int
    predicted: int
    differs: int | None

    @property
    def agrees(self) -> bool:
        """Whether that is the predicted tick."""
        return self.differs == self.predicted


def candidates(recording: Recording, response: Response) -> list[Answered]:
    """Return the holds that met an arm under way: it moved when they were given, and when they had come down."""
    ticks, lowest = recording.signal("servo.status", "tick"), recording.signal("servo.status", "target_velocity")
    speed = dict(zip(ticks.tolist(), np.abs(lowest).max(axis=1).tolist(), strict=True))
    found = [c for c in response.measured if c.what == "hold"]
    return [c for c in found if all(speed.get(c.predicted + k, 0.0) > MOVING_RAD_S for k in range(-8, 24, 8))]


def compare(
    config: RackConfig, commands: Sequence[CommandConfig], recording: Recording, command: Answered, folder: Path
) -> Twin:
    """Run the twin of a recording without `command`, one of those at the ticks of `commands`, and compare torques."""
    before = [other for other in commands if other.tick is not None and other.tick < command.given]
    seconds = (command.predicted + BEHIND_TICKS) * config.clock_ns * 1e-9
    twin = run(config, before, folder, seconds)
    differs = first_difference(recording, twin)
    return Twin(command.serial, command.level, command.given, command.predicted, differs)


def first_difference(first: Recording, second: Recording) -> int | None:
    """Return the first tick at which the torques of two runs differ in any bit, in the time that both have."""
    torques = [_torques(recording) for recording in (first, second)]
    for tick in sorted(torques[0].keys() & torques[1].keys()):
        if torques[0][tick] != torques[1][tick]:
            return tick
    return None


def _torques(recording: Recording) -> dict[int, bytes]:
    ticks, torques = recording.signal("servo.status", "tick"), recording.signal("servo.status", "torque")
    return {int(tick): torque.tobytes() for tick, torque in zip(ticks, torques, strict=True)}
