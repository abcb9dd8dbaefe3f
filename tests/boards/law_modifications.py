"""Control modifications for tests of racks."""

from __future__ import annotations

import numpy as np

from rack.levels.servo.modification import Hook, LawSample, Modification


class Lean(Modification):
    """Adds 4 N m to every joint."""

    hook = Hook.AFTER

    def modify(self, sample: LawSample) -> None:
        sample.torque += 4.0


class Breaks(Modification):
    """Fails in its 100th sample."""

    hook = Hook.BEFORE

    def begin(self, sample: LawSample) -> None:
        self.left = 100

    def modify(self, sample: LawSample) -> None:
        self.left -= 1
        if not self.left:
            sample.position[:] = np.nan
            raise KeyError("nothing left")
