"""The simulated hand: tensions behind valves, limits, forces on fingertips, exact restarts."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rack.levels.algebra import Array
from rack.levels.robot.cell import build_cell
from rack.levels.systems.hand.messages import EXTENSOR, FLEXOR
from rack.levels.systems.hand.simulated import SimulatedHand
from tests.levels.arms import config, save_state
from tests.levels.systems.hand.hand_rig import CLOCK_NS, EVERY

TICK_S = CLOCK_NS * 1e-9
INDEX1 = 1


def build_hand() -> SimulatedHand:
    robot, scene = config("utah_mit")
    return SimulatedHand(build_cell(robot, scene, CLOCK_NS), scene, CLOCK_NS, EVERY)


def flexed(hand: SimulatedHand, joint: int, flexor: float) -> Array:
    """Return the tensions at the start, with another one of a flexor."""
    tension = np.array(hand.commanded_tensions)
    tension[FLEXOR, joint] = flexor
    return tension


def test_tension_follows_its_command_after_the_delay_with_the_time_constant_of_the_valve() -> None:
    hand = build_hand()
    before = hand.sense().tension[FLEXOR, INDEX1]
    wanted, risen = flexed(hand, INDEX1, 65.0), []
    for _ in range(40):
        hand.apply_tensions(wanted)
        hand.step(1)
        risen.append((hand.sense().tension[FLEXOR, INDEX1] - before) / (65.0 - before))
    times = TICK_S * np.arange(1, 41) - 0.001
    # A sample is that of half a tick before, and controls are delayed by whole steps.
    assert risen == pytest.approx(np.maximum(0.0, 1.0 - np.exp(-times / 0.008)), abs=0.08)
    assert risen[0] == 0.0
    assert risen[-1] > 0.88
    sample = hand.sense()
    difference = sample.tension[FLEXOR] - sample.tension[EXTENSOR]
    assert sample.torque == pytest.approx(hand.hand.arms * difference)
    # The valves close by themselves when no command comes.
    hand.step(2 * EVERY - 1)
    assert not hand.braked
    hand.step(1)
    assert hand.braked


@pytest.mark.slow
def test_no_pull_breaks_a_limit_at_any_step() -> None:
    hand, rng = build_hand(), np.random.default_rng(3)
    for _ in range(20):
        flex = rng.random(16) < 0.5
        tension = np.where([flex, ~flex], hand.hand.most, hand.hand.least)
        for _ in range(20):
            hand.apply_tensions(tension)
            hand.step(EVERY)
    assert (hand.violations, hand.pushed, hand.first_violation, hand.fault) == (0, 0, "", "")


def test_contact_pushes_a_fingertip_away_from_what_it_touches() -> None:
    hand = build_hand()
    around = np.array([0.0, 0.70, 0.86, 0.75] * 3 + [0.0, 0.40, 0.72, 0.75])
    for _ in range(300):
        sample, tension = hand.sense(), np.array(hand.commanded_tensions)
        torque = 1.5 * (around - sample.position) - 0.1 * sample.velocity
        half = torque / (2 * hand.hand.arms)
        tension[FLEXOR], tension[EXTENSOR] = 20.0 + half, 20.0 - half
        hand.apply_tensions(tension.clip(hand.hand.least, hand.hand.most))
        hand.step(EVERY)
    force = hand.sense().force
    assert force[:3, 0].min() > 0.2  # fingers and thumb are on either side of the can
    assert force[3, 0] < -0.6
    # What MuJoCo finds at the contacts of the index, a step later.
    data, total = hand._data, np.zeros(3)
    mujoco.mj_forward(hand.cell.model, data)
    tip = hand.cell.model.site_bodyid[hand.hand.tips[0]]
    for number in range(data.ncon):
        contact, wrench = data.contact[number], np.zeros(6)
        mujoco.mj_contactForce(hand.cell.model, data, number, wrench)
        bodies = hand.cell.model.geom_bodyid[[contact.geom1, contact.geom2]]
        total += (bodies[1] == tip) * (wrench[:3] @ contact.frame.reshape(3, 3))
        total -= (bodies[0] == tip) * (wrench[:3] @ contact.frame.reshape(3, 3))
    palm = data.site_xmat[hand.cell.tool].reshape(3, 3)
    assert force[0] == pytest.approx(total @ palm, abs=0.05)


@pytest.mark.parametrize("closes", [False, True])
def test_a_restored_hand_continues_bit_for_bit(closes: bool) -> None:
    def run(hand: SimulatedHand, cycles: range) -> None:
        for cycle in cycles:
            if closes and cycle > 40:
                hand.close_valves()
            else:
                hand.apply_tensions(flexed(hand, INDEX1, 40.0 + 20.0 * np.sin(0.3 * cycle)))
            hand.step(EVERY)

    first, again = build_hand(), build_hand()
    run(first, range(60))
    middle = save_state(first)
    run(first, range(60, 90))
    again.restore(middle)
    run(again, range(60, 90))
    assert save_state(again).raw == save_state(first).raw
    assert all(np.array_equal(a, b) for a, b in zip(again.sense(), first.sense(), strict=True))
