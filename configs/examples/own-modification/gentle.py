"""A control modification of one's own: it limits what the servo law may add to the load, so that
the arm gives way."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from rack.levels.servo import Hook, LawContext, LawSample, Modification
from rack.levels.tables import Positive, Table, read_params


class GentleParams(Table):
    """What `params` of the modification may hold."""

    part: Positive = Field(0.2, le=1.0)
    """part of each joint's torque limit that may be added to its load"""


class Gentle(Modification):
    """Carries the arm's weight and motion in full, and corrects errors with part of the torque
    only."""

    hook = Hook.AFTER
    params = GentleParams

    def __init__(self, context: LawContext) -> None:
        super().__init__(context)
        self.most = (
            read_params(GentleParams, context.params).part * context.torque
        )  # (joints,), N m

    def modify(self, sample: LawSample) -> None:
        """Limit the law's torque."""
        added = np.minimum(np.maximum(sample.torque - sample.load, -self.most), self.most)
        sample.torque = sample.load + added
