"""The grip on an object: internal forces that do not move it, and forces that hold it in place.

Fingers that act together are treated as one virtual finger (Arbib, Iberall and Lyons, 1985). The
opposing finger presses along the line from its tip to the mean of the other tips, and the others
press back along the same line in equal shares. The sum and the moment of these forces are zero for
any position of the tips.

The springs at the tips react to weight and pull at once, but yield. An integral of the object's
displacement from its anchor brings it back, half of the force at the opposing tip and half at the
others. The integral
slowly takes over the common load of the springs: the points of all tips follow tips that have crept
or slipped, while the forces stay the same. Friction bears more with a firmer grip, so the grip
force rises at once with the sensed load and falls slowly after it.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from rack.levels.algebra import Array, Mask, norm
from rack.levels.tables import NotNegative, Positive, Table

FALL_N_S = 4.0
"""Rate at which the grip force falls after a load is removed, N/s."""
LEAST_SPAN_M = 1e-3
"""Smallest distance of opposing tips at which they can grip, m."""


class GripGains(Table):
    """Gains and limits of the grip."""

    stiffness: Positive = Field(300.0, le=5000.0)
    """stiffness of each tip about its point [N/m]; the opposing tip has the sum of the others"""
    recover: NotNegative = 4000.0
    """integral gain of the force on a displaced object [N/(m s)]"""
    creep: NotNegative = Field(0.5, le=5.0)
    """rate at which points follow tips that have crept [1/s]"""
    most_load: NotNegative = 8.0
    """largest force of the integral [N]"""
    reserve: NotNegative = Field(0.5, le=5.0)
    """increase of the grip force with the sensed load, N/N"""
    most_grip: Positive = 14.0
    """largest force of the opposing finger [N]"""


class HandGrip:
    """The grip of several fingers, one of which opposes the others.

    All forces are forces of the tips on the object.
    """

    def __init__(self, gains: GripGains, fingers: Mask, opposing: int, period_s: float) -> None:
        """Start without force.

        Args:
            gains: Gains and limits.
            fingers: Mask of the gripping fingers, (fingers,).
            opposing: Index of the finger that opposes the others.
            period_s: Time between two updates, s.
        """
        self._gains = gains
        self._period_s = period_s
        self._opposing = opposing
        self.fingers = fingers
        self._others = fingers.copy()
        self._others[opposing] = False
        count = max(1, int(self._others.sum()))
        self.shares = fingers / count  # (fingers,): share of the grip force
        self.shares[opposing] *= count
        self.stiffness = gains.stiffness * count * self.shares  # (fingers,), N/m
        self.force = 0.0  # N: grip force, of the opposing finger
        self.load = np.zeros(3)  # N: total force of the tips against weight and pull

    def adapt_force(self, base: float, sensed: Array) -> None:
        """Set the grip force to `base` plus a share of the sensed load.

        The force rises at once, up to `most_grip`, and falls at no more than `FALL_N_S`.

        Args:
            base: Grip force without a load, N.
            sensed: Sensed forces on the tips, (fingers, 3), N.
        """
        borne = norm(sensed[self._others].sum(axis=0) + sensed[self._opposing])
        wanted = min(base + self._gains.reserve * borne, self._gains.most_grip)
        self.force = max(wanted, self.force - FALL_N_S * self._period_s)

    def correct_position(self, away: Array) -> None:
        """Adjust the load to pull the object back to its anchor (integral control).

        Args:
            away: Displacement of the object from its anchor, (3,), m.
        """
        self.load -= self._gains.recover * self._period_s * away
        excess = norm(self.load)
        if excess > self._gains.most_load:
            self.load *= self._gains.most_load / excess

    def follow_creep(self, points: Array, tips: Array) -> None:
        """Move the points of the springs towards the tips, all by the same displacement.

        The load is adjusted so that the total force stays the same.

        Args:
            points: Points of the springs, (fingers, 3), m; modified in place.
            tips: Positions of the tips, (fingers, 3), m.
        """
        stiffness = self.stiffness[:, None]
        whole = float(self.stiffness.sum())
        shift = (
            self._gains.creep * self._period_s * (stiffness * (tips - points)).sum(axis=0) / whole
        )
        points[self.fingers] += shift
        self.load -= whole * shift

    def find_forces(self, tips: Array) -> Array:
        """Return the forces of the fingers on the object, (fingers, 3), in N.

        Args:
            tips: Positions of the tips, (fingers, 3), m.
        """
        return np.asarray(
            self.shares[:, None]
            * (0.5 * self.load - self.force * self.find_outward_directions(tips))
        )

    def find_outward_directions(self, tips: Array) -> Array:
        """Return unit vectors from the object to each tip, (fingers, 3).

        They are zero for fingers that do not grip.
        """
        directions = np.zeros_like(tips)
        line = tips[self._opposing] - (self.shares[:, None] * tips)[self._others].sum(axis=0)
        span = norm(line)
        if span > LEAST_SPAN_M:
            directions[self._others] = -line / span
            directions[self._opposing] = line / span
        return directions
