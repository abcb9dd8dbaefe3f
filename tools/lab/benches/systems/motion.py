"""The same motion by every rack with a PUMA 560, from home through three poses; and how soon it is
stopped.

A rack has it as a config of its own, next to it: `<name>/three-poses.toml` in the folder of a rack,
or `<name>-three-poses.toml`. All runs are in lockstep. In two more of them an operator stops the
arm where it is fastest on its way to the first pose: by a hold of the highest level that takes one,
and by the emergency stop. What host boards sent in the first run enters these at the same ticks, so
that all three are the same until then.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rack.backplane.layout import Layout
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.boards.config import RackConfig, load, wire
from rack.boards.config.cell import built_cell
from rack.boards.config.files import CONFIGS, file_at, read
from rack.boards.config.schema import CommandConfig
from rack.levels.algebra import Array, norm
from rack.levels.planning.ik import InverseKinematics
from rack.levels.systems.joint_boards.messages import DRIVING
from rack.tools.console.answer import Failure
from rack.tools.lab.benches.observed import UNVIEWED, Deed, observe, record
from rack.tools.lab.benches.systems.hold import hold_paths

ALONE = "one-machine"
"""The config of a system in one rack, where its main one needs other racks."""
LONGEST_S = 12.0
"""Simulated time of the run in which the motion must end."""
REST_RAD_S = 1e-3
"""Speed of its fastest joint below which an arm rests."""
NEAR_RAD = 2e-3
"""Distance of the farthest joint within which a pose is reached."""
STOPPING_S = 2.0
"""Simulated time from the last torque that could be without a stop until the arm rests."""
TOOL_SAMPLES = 400
"""Points of the motion at which the tool is compared with where it should be."""


@dataclass(frozen=True)
class Stop:
    """An operator's stop: by what, and the time from giving it until the arm rested for good, ms;
    None: it did not.

    `speed` is that of the fastest joint when it was given, rad/s.
    """

    by: str
    speed: float
    rest_ms: float | None


@dataclass(frozen=True)
class PosesRun:
    """The motion of one rack. Times are simulated.

    `begins_s` is from the start of the run, `lasts_s` from the first motion to rest in the last
    pose. Tracking errors are those of the joints while their targets move, mrad, `tool_mm` is the
    largest distance of the tool from its target. `reached` counts the poses in which the arm came
    to rest. `hold` is None if no level takes one.
    """

    begins_s: float
    lasts_s: float
    rms_mrad: float
    peak_mrad: float
    tool_mm: float
    reached: int
    hold: Stop | None
    emergency: Stop

    @property
    def verdict(self) -> str:
        """What was done, in words."""
        return f"{self.reached} poses in {self.lasts_s:.1f} s"


@dataclass(frozen=True)
class _Moved:
    """What the board of an arm has reported, cycle by cycle, in rad and rad/s, each array of shape
    (n, joints)."""

    tick: np.ndarray  # (n,)
    position: np.ndarray
    velocity: np.ndarray
    target: np.ndarray
    target_velocity: np.ndarray

    @property
    def speed(self) -> np.ndarray:
        """Speed of the fastest joint, rad/s, shape (n,)."""
        return np.asarray(np.abs(self.velocity).max(axis=1))


def rests_at(tick: np.ndarray, velocity: np.ndarray) -> int | None:
    """Return the tick from which an arm rests for good; None if it moves to the end."""
    moving = np.flatnonzero(np.abs(velocity).max(axis=1) > REST_RAD_S)
    if not len(moving):
        return int(tick[0])
    return None if moving[-1] + 1 == len(tick) else int(tick[moving[-1] + 1])


def three_poses() -> Array:
    """Return the poses, shape (3, joints), rad."""
    actions = read(CONFIGS / "tasks" / "three-poses.toml")["task"]["action"]
    return np.array([action["joints"] for action in actions])


def poses_config(name: str) -> Path | None:
    """Return the config in which a rack does the motion; None if it has none."""
    own = (
        file_at(Path(name))
        or file_at(CONFIGS / name / f"{name}.toml")
        or file_at(CONFIGS / f"{name}.toml")
    )
    if own is None:
        return None
    motion = "three-poses.toml"
    if own.stem not in (own.parent.name, ALONE):
        motion = f"{own.stem}-{motion}"
    return file_at(own.parent / motion)


class StopRun(NamedTuple):
    """A run with a stop at `tick`, whose command takes `longest` ticks at most to the torque."""

    tick: int
    longest: int
    deeds: tuple[Deed, ...]


class PosesBench:
    """The three runs of one rack's motion."""

    def __init__(self, path: Path, rack: str, share: bool) -> None:
        own = (f"name={rack}", "clock.mode=lockstep", "clock.speed=1.0")
        self._config = load(path, [*own, *UNVIEWED])
        self._layout: Layout = wire(self._config)
        self._share = share
        self._arm = next(box.name for box in self._layout.mailboxes if box.message in DRIVING)

    def measure(self, folder: Path) -> PosesRun:
        """Run the motion, then stop it twice; record it into `folder`. Raises `Failure` if the arm
        does not move."""
        recording = record(self._config, LONGEST_S, folder, self._share).recording
        fields = ("tick", "position", "velocity", "target", "target_velocity")
        moved = _Moved(*(recording.signal(self._arm, field) for field in fields))
        fastest = self._fastest(moved)
        emergency = self._stopped(
            self._config, "emergency stop", StopRun(fastest, 0, (Deed(fastest, _latch),))
        )
        return self._figures(moved, self._hold(fastest), emergency)

    def _figures(self, moved: _Moved, hold: Stop | None, emergency: Stop) -> PosesRun:
        moving = np.abs(moved.target_velocity).max(axis=1) > 0.0
        error = moved.position[moving] - moved.target[moving]
        begins = int(moved.tick[moving][0])
        rests = rests_at(moved.tick, moved.velocity)
        if rests is None:
            rests = int(moved.tick[-1])
        second = self._layout.clock_ns * 1e-9
        still = moved.position[moved.speed <= REST_RAD_S]
        near = [np.abs(still - pose).max(axis=1).min() < NEAR_RAD for pose in three_poses()]
        return PosesRun(
            begins_s=begins * second,
            lasts_s=(rests - begins) * second,
            rms_mrad=1e3 * float(np.sqrt(np.mean(error**2))),
            peak_mrad=1e3 * float(np.abs(error).max()),
            tool_mm=1e3 * self._tool_error(moved.position[moving], moved.target[moving]),
            reached=int(sum(near)),
            hold=hold,
            emergency=emergency,
        )

    def _fastest(self, moved: _Moved) -> int:
        """Return the tick at which the arm is fastest on its way to the first pose."""
        moving = np.abs(moved.target_velocity).max(axis=1) > 0.0
        if not moving.any():
            raise Failure(f"{self._config.name}: the arm did not move in {LONGEST_S:g} s")
        first = int(moving.argmax())
        last = first + int(np.append(~moving[first:], True).argmax())
        return int(moved.tick[first + moved.speed[first:last].argmax()])

    def _tool_error(self, position: np.ndarray, target: np.ndarray) -> float:
        """Return the largest distance of the tool from its target, m."""
        ik = InverseKinematics(built_cell(self._config), 0)
        some = np.unique(np.linspace(0, len(position) - 1, TOOL_SAMPLES, dtype=int))
        pairs = [(ik.tool_at(position[k]).position, ik.tool_at(target[k]).position) for k in some]
        return max(float(norm(is_at - wanted)) for is_at, wanted in pairs)

    def _hold(self, tick: int) -> Stop | None:
        paths = hold_paths(self._config)
        if not paths:
            return None
        hold = CommandConfig(level=paths[0].levels[0], what="hold", tick=tick)
        config = self._config.model_copy(update={"command": (*self._config.command, hold)})
        return self._stopped(config, hold.level, StopRun(tick, paths[0].longest, ()))

    def _stopped(self, config: RackConfig, by: str, run: StopRun) -> Stop:
        tick_s = self._layout.clock_ns * 1e-9
        seconds = (run.tick + run.longest) * tick_s + STOPPING_S
        rows = observe(config, seconds, self._share, (self._arm,), run.deeds).messages[self._arm]
        after = rows[rows["tick"] >= run.tick]
        velocity = after["message"]["velocity"]
        rests = rests_at(after["tick"], velocity)
        speed = float(np.abs(velocity[0]).max())
        rest_ms = None if rests is None else (rests - run.tick) * tick_s * 1e3
        return Stop(by, speed, rest_ms)


def _latch(segment: Segment) -> None:
    UtilityLines(segment).latch_emergency_stop()
