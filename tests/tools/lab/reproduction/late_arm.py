"""An arm that ignores how late its cycles begin, for tests of claims about smooth motion."""

from __future__ import annotations

from rack.levels.arm import SimulatedArm


class PunctualArm(SimulatedArm):
    """A simulated arm that is sampled and driven at the grid points, whatever the clock does."""

    def step(self, ticks: int) -> None:
        self.late_s = 0.0
        super().step(ticks)
