"""The trajectories that the planner has made for the segments at hand."""

from __future__ import annotations

from collections.abc import Collection

from rack.levels.level import Reading
from rack.levels.messages import Error
from rack.levels.primitive.fault import Fault
from rack.levels.primitive.trajectory import Trajectory


class Plans:
    """Keeps the newest trajectory, or refusal, of every segment in the window."""

    def __init__(self) -> None:
        self._trajectories: dict[int, Trajectory] = {}
        self._refusals: dict[int, Fault] = {}

    def accept(self, plan: Reading, window: Collection[int]) -> None:
        """Take over a new plan; forget those of segments that have left the window."""
        for kept in (self._trajectories, self._refusals):
            for serial in [s for s in kept if s not in window]:
                del kept[serial]
        message = plan.value
        serial = message.segment
        if not plan.is_new or serial not in window:
            return
        if message.error:
            self._refusals[serial] = Fault(Error(message.error), message.reason, message.earliest)
        else:
            self._trajectories[serial] = Trajectory(message.sections[: message.count].copy(), message.duration)
            self._refusals.pop(serial, None)

    def trajectory(self, serial: int, begin: float = 0.0) -> Trajectory | None:
        """Return the trajectory of a segment from path parameter `begin`, if it has been made."""
        trajectory = self._trajectories.get(serial)
        return trajectory if trajectory is not None and trajectory.begin == begin else None

    def lacks(self, serial: int, begin: float) -> bool:
        """Say whether neither a trajectory from `begin` nor a refusal of the segment is there."""
        return self.trajectory(serial, begin) is None and serial not in self._refusals

    def refusal(self, serial: int) -> Fault | None:
        """Return why the planner makes none for a segment."""
        return self._refusals.get(serial)
