"""The grip on an object: internal forces that do not move it, and forces that keep it where it is.

The fingers that share one task are taken as one virtual finger (Arbib, Iberall and Lyons, 1985):
the opposing finger presses along the line from its tip to the mean of the other tips, those press
back along the same line, in equal parts. Forces so chosen have neither sum nor moment, wherever the
tips are. Against weight and pull the springs at the tips act at once, and give way; an integral of
the object's distance from its anchor brings it back, half of it at the opposing tip, half at the
others. What the springs bear together for long it takes over: the points of all tips follow where
these have crept or slipped to, and the forces stay. Friction bears more the harder the grip is: the
grip rises at once with the load sensed at the tips, and falls slowly after it.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from rack.levels.algebra import Array, Mask, norm
from rack.levels.tables import NotNegative, Positive, Table

FALL_N_S = 4.0
"""Rate at which the grip falls when a load is gone, N/s."""
LEAST_SPAN_M = 1e-3
"""Tips closer to each other than this oppose nothing."""


class GripGains(Table):
    """Gains of the grip, and its limits."""

    stiffness: Positive = Field(300.0, le=5000.0)
    """of each tip about its point, N/m; of the opposing one, as of all others together"""
    recover: NotNegative = 4000.0
    """rise of the force on an object, for its distance, N/(m s)"""
    creep: NotNegative = Field(0.5, le=5.0)
    """rate at which points follow tips that have crept, 1/s"""
    most_load: NotNegative = 8.0
    """largest such force, N"""
    reserve: NotNegative = Field(0.5, le=5.0)
    """rise of the grip with the load sensed, N/N"""
    most_grip: Positive = 14.0
    """largest force of the opposing finger, N"""


class HandGrip:
    """The grip of some fingers, of which one opposes the others. All forces are of the tips on the
    object."""

    def __init__(self, gains: GripGains, fingers: Mask, opposing: int, period_s: float) -> None:
        """Grip with `fingers`, (fingers,), every `period_s`."""
        self._gains = gains
        self._period_s = period_s
        self._opposing = opposing
        self.fingers = fingers
        self._others = fingers.copy()
        self._others[opposing] = False
        count = max(1, int(self._others.sum()))
        self.shares = fingers / count  # (fingers,): of the grip
        self.shares[opposing] *= count
        self.stiffness = gains.stiffness * count * self.shares  # (fingers,), N/m
        self.force = 0.0  # N: of the opposing finger
        self.load = np.zeros(3)  # N: by which the tips together press against weight and pull

    def adapt_force(self, base: float, sensed: Array) -> None:
        """Set the grip to `base`, N, and more by the load on the tips; `sensed`, (fingers, 3), N:
        on the tips."""
        borne = norm(sensed[self._others].sum(axis=0) + sensed[self._opposing])
        wanted = min(base + self._gains.reserve * borne, self._gains.most_grip)
        self.force = max(wanted, self.force - FALL_N_S * self._period_s)

    def recover_position(self, away: Array) -> None:
        """Press more against what holds the object `away`, (3,), m, from its anchor."""
        self.load -= self._gains.recover * self._period_s * away
        excess = norm(self.load)
        if excess > self._gains.most_load:
            self.load *= self._gains.most_load / excess

    def follow_creep(self, points: Array, tips: Array) -> None:
        """Let the `points` of the springs, (fingers, 3), m, follow the tips, all by the same
        way."""
        stiffness = self.stiffness[:, None]
        whole = float(self.stiffness.sum())
        way = self._gains.creep * self._period_s * (stiffness * (tips - points)).sum(axis=0) / whole
        points[self.fingers] += way
        self.load -= whole * way

    def find_forces(self, tips: Array) -> Array:
        """Return the force of every finger with its tip at `tips`, (fingers, 3), m: (fingers, 3),
        N."""
        return np.asarray(
            self.shares[:, None]
            * (0.5 * self.load - self.force * self.find_outward_directions(tips))
        )

    def find_outward_directions(self, tips: Array) -> Array:
        """Return the directions in which the tips leave the object, (fingers, 3), length 1; 0 for
        other fingers."""
        directions = np.zeros_like(tips)
        line = tips[self._opposing] - (self.shares[:, None] * tips)[self._others].sum(axis=0)
        span = norm(line)
        if span > LEAST_SPAN_M:
            directions[self._others] = -line / span
            directions[self._opposing] = line / span
        return directions
