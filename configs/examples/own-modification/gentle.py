"""A control modification that makes the arm yield.

It limits the torque that the servo law adds to the load torque.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from rack.levels.servo import Hook, LawContext, LawSample, Modification
from rack.levels.tables import Positive, Table, read_params


class GentleParams(Table):
    """Parameters of the modification."""

    part: Positive = Field(0.2, le=1.0)
    """fraction of each joint's torque limit that may be added to its load torque"""


class Gentle(Modification):
    """Applies the full load torque, and corrects errors with a fraction of the torque limit."""

    hook = Hook.AFTER
    params = GentleParams

    def __init__(self, context: LawContext) -> None:
        super().__init__(context)
        self.most = (
            read_params(GentleParams, context.params).part * context.torque
        )  # (joints,), N m

    def modify(self, sample: LawSample) -> None:
        """Limit the torque that the law adds to the load torque."""
        added = np.minimum(np.maximum(sample.torque - sample.load, -self.most), self.most)
        sample.torque = sample.load + added
