"""The surroundings of trials: a load on the machine, leftovers of racks, and a check of the
violation counter.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from rack.backplane.process import COPY, die_with_parent, is_alive
from rack.backplane.segment import SHM_FOLDER
from rack.boards.config.schema import RackConfig
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import await_ends, descendants

BOUND_S = 2.0
"""Time that killed processes get to end."""
COMM_LENGTH = 15
"""Characters that the kernel keeps of a process's name."""
FACTOR = 2.0
"""Velocity that the violation counter must count, as a multiple of the limit."""
BUSY = ("sh", "-c", "while :; do :; done")
WRITING = ("sh", "-c", "while :; do sync; done")


def children() -> set[int]:
    """Return the living processes that descend from this one."""
    found = {pid for pid in descendants(os.getpid()) if is_alive(pid)}
    # The snapshots of a crate that serves several racks end with that.
    return {pid for pid in found if not _name(pid).startswith(COPY)}


def left_behind(rack: str, before: set[int]) -> list[str]:
    """Return everything left of a rack, segments and semaphores by name, processes by pid, each as
    one readable text.

    `before`: descendants of this process that were there before the rack.
    """
    await_ends({*_named(rack), *(children() - before)}, BOUND_S)
    processes = _named(rack) | (children() - before)
    files = [str(path) for path in sorted(SHM_FOLDER.iterdir()) if rack in path.name]
    return files + [f"process {pid} ({_name(pid)})" for pid in sorted(processes)]


def _named(rack: str) -> set[int]:
    """Return the processes with names of a rack's boards, whatever their parent is."""
    start = f"{rack}:"[:COMM_LENGTH]
    pids = (int(path.name) for path in Path("/proc").glob("[0-9]*"))
    return {pid for pid in pids if _name(pid).startswith(start) and is_alive(pid)}


def _name(pid: int) -> str:
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/comm").read_text().rstrip("\n")
    return ""


def examine(config: RackConfig) -> None:
    """Check the violation counter: move every joint at twice its limit for one tick.

    A campaign that says "no limit violated" must be able to see a violation. Raises `Failure` where
    it is not counted.
    """
    # Only here: the workers, which make the trials, need none of them.
    from numpy import isfinite

    from rack.levels.arm import SimulatedArm
    from rack.levels.arm.substeps import copy_state
    from rack.levels.messages import ArmState
    from rack.levels.robot.cell import build_cell, sizes

    if config.robot is None:
        return
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    for joint, (dof, limit) in enumerate(zip(cell.dof, cell.bounds.velocity, strict=True)):
        if not isfinite(limit):
            continue
        arm = SimulatedArm(cell, config.scene, config.clock_ns)
        data = cell.start()
        state = ArmState.zeros(sizes(cell))
        arm.save(state)
        data.qvel[dof] = FACTOR * limit
        copy_state(cell.model._address, data._address, data.tree_asleep, state.state)
        arm.restore(state)
        arm.step(1)
        if not arm.violations:
            name = config.robot.joints[joint]
            speed = f"{FACTOR * limit:g} rad/s"
            raise Failure(
                f"violation counter: joint '{name}' at {speed}, twice its limit, is not counted"
            )


@contextmanager
def load() -> Iterator[str]:
    """Keep every core that this process may use busy, and the disks; yields the load in words.

    Uses `stress-ng` where it is installed.
    """
    cores = os.sched_getaffinity(0)
    words = f"{len(cores)} busy processes and one that writes"
    commands: list[tuple[Sequence[str], set[int]]]
    commands = [*((BUSY, {core}) for core in cores), (WRITING, cores)]
    if shutil.which("stress-ng") is not None:
        words = f"stress-ng --cpu {len(cores)} --io 1"
        commands = [(words.split(), cores)]
    with ExitStack() as stack:
        for command, its_cores in commands:
            process = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                preexec_fn=partial(_begin, os.getpid(), its_cores),
            )
            stack.callback(process.wait)
            # Terminated, not killed: stress-ng then ends its own processes.
            stack.callback(process.terminate)
        yield words


def _begin(parent: int, cores: set[int]) -> None:
    """Begin as a process of the load, on these cores, which ends with its parent."""
    die_with_parent(parent)
    os.sched_setaffinity(0, cores)
