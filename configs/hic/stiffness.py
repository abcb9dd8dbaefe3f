"""Push a finger of rack hic at several pretensions, and print the stiffness of its joints.

python stiffness.py [T0 ...]
"""

from __future__ import annotations

import sys

import numpy as np

from rack.boards.config import load
from rack.levels.robot.cell import build_cell
from rack.levels.systems.hand.simulated import SimulatedHand

JOINTS = slice(1, 4)
"""Joints of the index finger that flex it."""
PUSH_N = 0.3
SHORT_S, LONG_S = 0.01, 1.0


def measure_stiffness(rest_n: float, is_open: bool) -> np.ndarray:
    """Push the tip of the index finger towards the palm, and return the stiffness of `JOINTS`.

    Args:
        rest_n: Pretension T0, the mean tension of each pair of tendons, N.
        is_open: True to push for `SHORT_S` while the valves hold constant tensions. False to push
            until the finger rests, with closed valves.

    Returns:
        Change of the tendons' torque per change of the joint's position, (joints,), N m/rad.
    """
    config = load("hic", [f"robot.hand.rest={rest_n}"])
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    hand = SimulatedHand(cell, config.scene, config.clock_ns)
    data = hand._data
    tension = hand.commanded_tensions
    fingertip = cell.model.site_bodyid[hand.hand.tips[0]]
    out_of_palm = data.site_xmat[cell.tool].reshape(3, 3)[:, 2]
    samples = []
    for force, seconds in ((0.0, LONG_S), (PUSH_N, SHORT_S if is_open else LONG_S)):
        data.xfrc_applied[fingertip, :3] = -force * out_of_palm
        for _ in range(round(seconds * 1e9 / config.clock_ns)):
            if is_open:
                hand.apply_tensions(tension)
            hand.step(1)
        sample = hand.sense()
        samples.append(np.stack((sample.position, sample.torque)))
    position, torque = (samples[1] - samples[0])[:, JOINTS]
    return -torque / position


def main(rests_n: list[float]) -> None:
    """Print a row for each pretension and each state of the valves."""
    print("T0, N  valves   index1  index2  index3  N m/rad")
    for rest_n in rests_n:
        for is_open in (False, True):
            values = "  ".join(f"{value:6.2f}" for value in measure_stiffness(rest_n, is_open))
            print(f"{rest_n:5g}  {'open' if is_open else 'closed':6}   {values}")


if __name__ == "__main__":
    main([float(argument) for argument in sys.argv[1:]] or [5.0, 15.0, 40.0])
