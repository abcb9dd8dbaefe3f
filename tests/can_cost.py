"""Measures what the bus of the example `can-arm` costs in a cycle: `python -m tests.can_cost`.

Its arm, held by torques, is exchanged with at 500 Hz; each drive is a process.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from multiprocessing import get_context
from pathlib import Path
from time import monotonic, perf_counter, sleep

import numpy as np

from rack.backplane.process import read_processor_ns, set_priority
from rack.boards.config import load
from rack.levels.arm import DriveState
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics
from rack.tools.console.answer import print_json
from tests.processes import own_can_channel

EXAMPLE = Path(__file__).parent.parent / "configs" / "examples" / "can-arm"
CYCLES = 4000
MOST_S = 40.0
"""Where drives are not on for `CYCLES` by then, the cycles missing are not in time."""
SETTLING_S = 0.2
"""In which a joint that moves is brought to rest: on a slow machine torques of rest alone do not
hold the arm."""
PRIORITY = 80
"""That of the servo level."""


def main() -> None:
    """Print the cost of a cycle, the age of samples, and what a drive takes of a core."""
    sys.path.insert(0, str(EXAMPLE))
    os.environ.setdefault("CAN_CHANNEL", own_can_channel())
    from can_arm import CanArm
    from drive import run_drive
    from mechanics import Mechanics

    config = load(str(EXAMPLE / "can-arm.toml"))
    assert config.robot is not None
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    tick_s = config.clock_ns * 1e-9
    dynamics = Dynamics(cell)
    terms = dynamics.terms(cell.home, np.zeros(len(cell.home)))
    hold, damping = terms.bias.copy(), terms.inertia.diagonal() / SETTLING_S
    mechanics = Mechanics(cell, monotonic())
    arm = CanArm(cell, config.scene, config.clock_ns)
    fork = get_context("fork")
    drives = [
        fork.Process(
            target=run_drive, args=(node, mechanics, (tick_s, 0.01), os.getpid()), daemon=True
        )
        for node in range(1, len(cell.home) + 1)
    ]
    for drive in drives:
        drive.start()
    set_priority(PRIORITY)
    arm.enable()
    costs = []
    ages: Counter[int] = Counter()
    start_s = monotonic()
    used_ns = [read_processor_ns(drive.pid or 0) for drive in drives]
    while len(costs) < CYCLES and monotonic() < start_s + MOST_S:
        due = int((monotonic() - start_s) / tick_s) + 1
        sleep(max(0.0, start_s + due * tick_s - monotonic()))
        begun = perf_counter()
        arm.step(due - arm.tick)
        sample = arm.sense()
        if arm.state is DriveState.ENABLED:
            arm.drive(hold - damping * sample.velocity, 0.0)
            costs.append(perf_counter() - begun)
            ages[arm.tick - sample.tick] += 1
        else:
            arm.brake()
    taken_s = monotonic() - start_s
    share = np.mean(
        [read_processor_ns(d.pid or 0) - n for d, n in zip(drives, used_ns, strict=True)]
    )
    if not costs:
        sys.exit(f"the drives were not on within {MOST_S:g} s: {arm.fault or 'no fault'}")
    median, high = 1e3 * np.percentile(costs, (50, 99))
    if "--json" in sys.argv:
        print_json({"exchange_ms": {"p50": median, "p99": high}, "in_time": ages[1] / CYCLES})
    else:
        print(f"a cycle: {median:.3f} ms (median), {high:.3f} ms (99th percentile)")
        print(f"age of samples, ticks: {dict(sorted(ages.items()))}")
        print(f"a drive: {share * 1e-9 / taken_s:.2f} of a core")
    arm._bus.shutdown()


if __name__ == "__main__":
    main()
