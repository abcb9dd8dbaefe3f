"""The law of the tendons: least tensions, torque limits, and valves that lag and err."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rack.levels.algebra import Array
from rack.levels.level import LevelContext
from rack.levels.systems.hand.laws import TendonGains, TendonLaw
from rack.levels.systems.hand.messages import HandStatus
from tests.levels.arms import cell, config

EVERY, TICK_NS, LAG_S, SUBSTEPS = 4, 500_000, 0.008, 8
CONTEXT = LevelContext("tendon", EVERY, 1, TICK_NS, 0, *config("utah_mit"), {}, {})
PERIOD_S = CONTEXT.period_s
EXACT = TendonGains(lead=0.0, trim=0.0, margin=0.0)


class Valves:
    """Valves of all tendons with gain, offset and lag. Sensed tensions are a cycle old."""

    def __init__(self, gain: float = 1.0, offset: float = 0.0, gains: TendonGains = EXACT) -> None:
        hand = cell("utah_mit").hand
        assert hand is not None
        self.hand, self._gain, self._offset = hand, gain, offset
        joints = len(hand.arms)
        self.status = HandStatus.zeros({"joints": joints, "fingers": 4})
        self.status.tension = self.status.wanted = self.hand.rest
        self.tension = np.full((2, joints), self.hand.rest)
        self.wanted = self.tension.copy()
        self.law = TendonLaw(self.hand, np.full(joints, True), gains, CONTEXT)
        self.law.start(self.status)
        self.histories: list[Array] = []

    def run(self, torque: Array, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            sensed, wanted = self.tension.copy(), self.wanted.copy()
            self.law.set_tensions(self.status, torque, self.wanted)
            for _ in range(SUBSTEPS):
                aim = self._gain * self.wanted + self._offset
                part = 1.0 - math.exp(-PERIOD_S / SUBSTEPS / LAG_S)
                self.tension += (aim - self.tension) * part
            self.status.tension, self.status.wanted = sensed, wanted
            self.status.tick += EVERY
            self.histories.append(self.torque)

    @property
    def torque(self) -> Array:
        return np.asarray(self.hand.arms * (self.tension[0] - self.tension[1]))


@pytest.mark.parametrize("part", [0.0, 0.1, -0.1, 0.5, -0.9, 1.0, -1.0])
def test_tensions_give_the_torque_and_none_is_slack(part: float) -> None:
    valves = Valves()
    hand = valves.hand
    torque = part * hand.torque
    valves.law.set_tensions(valves.status, torque, valves.wanted)
    flexors, extensors = valves.wanted
    assert hand.arms * (flexors - extensors) == pytest.approx(torque)
    assert valves.wanted.min() >= hand.least
    assert (valves.wanted <= hand.most + 1e-9).all()
    half = np.abs(torque) / hand.arms / 2
    easy = (hand.rest - half >= hand.least) & (hand.rest + half <= hand.most)
    higher = np.minimum(np.maximum(hand.rest, hand.least + half), hand.most - half)
    mean = np.where(easy, hand.rest, higher)
    assert (flexors + extensors) / 2 == pytest.approx(mean)
    assert valves.law.clipped == 0


def test_a_torque_beyond_the_tendons_is_clipped_and_counted() -> None:
    valves = Valves()
    valves.law.set_tensions(valves.status, 3.0 * valves.hand.torque, valves.wanted)
    assert valves.wanted[0] == pytest.approx(valves.hand.most)
    assert valves.wanted[1] == pytest.approx(valves.hand.least)
    assert valves.law.clipped == 1


def test_a_lead_brings_torques_earlier_without_overshoot() -> None:
    after = {}
    for lead in (0.0, 1.0):
        valves = Valves(gains=TendonGains(lead=lead, trim=0.0))
        torque = 0.1 * valves.hand.torque
        valves.run(torque, 3.0)
        missing = 1.0 - np.array(valves.histories)[:, 0] / torque[0]
        assert missing[-1] == pytest.approx(0.0, abs=1e-9)
        assert missing.min() > -0.01
        after[lead] = int((missing > math.exp(-1)).sum())
    assert after[1.0] <= 0.6 * after[0.0]


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "offset"), [(0.9, 0.0), (1.1, 0.0), (1.0, 1.0), (0.95, -0.8)])
def test_lasting_errors_of_valves_are_learned(gain: float, offset: float) -> None:
    valves = Valves(gain, offset, TendonGains())
    torque = 0.1 * valves.hand.torque
    valves.run(torque, 3.0)
    assert valves.torque == pytest.approx(torque, rel=1e-3)
    assert valves.tension.min() >= valves.hand.least
    # With a larger torque, the error of a gain is learned again.
    valves.run(-2.0 * torque, 3.0)
    assert valves.torque == pytest.approx(-2.0 * torque, rel=1e-3)


def test_valves_that_are_closed_teach_nothing() -> None:
    valves = Valves(gains=TendonGains())
    torque = 0.1 * valves.hand.torque
    valves.run(torque, 1.0)
    before = valves.wanted.copy()
    valves.status.holding = 1
    for _ in range(500):
        valves.status.tick += EVERY
        valves.status.tension += 0.1
        valves.law.set_tensions(valves.status, torque, valves.wanted)
    assert valves.wanted == pytest.approx(before)
    # A sensor that returns NaN must not change the trim either.
    valves.status.holding, valves.status.tension[0, 0] = 0, math.nan
    valves.status.tick += EVERY
    valves.law.set_tensions(valves.status, np.zeros(16), valves.wanted)
    assert np.isfinite(valves.wanted).all()
