"""Surroundings of trials: load, leftovers of racks, and a check of the violation counter."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

from rack.backplane.process import COPY_PREFIX, die_with_parent, is_alive
from rack.backplane.segment import SHM_FOLDER
from rack.boards.config.schema import RackConfig
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import await_ends, list_descendants

BOUND_S = 2.0
"""Maximum wait in s for killed processes to end."""
COMM_LENGTH = 15
"""Number of characters of a process's name that the kernel keeps."""
SPEED_FACTOR = 2.0
"""Velocity that the violation counter must count, as a multiple of the limit."""
BUSY = ("sh", "-c", "while :; do :; done")
WRITING = ("sh", "-c", "while :; do sync; done")


def list_living_descendants() -> set[int]:
    """Return the process ids of all living descendants of this process except snapshots."""
    return {
        pid
        for pid in list_descendants(os.getpid())
        # Snapshots end with their crate, which may serve several racks.
        if not _read_name(pid).startswith(COPY_PREFIX) and is_alive(pid)
    }


def find_leftovers(rack: str, pids_before: set[int]) -> list[str]:
    """Return the files and processes that a rack left behind.

    Args:
        rack: Name of the rack.
        pids_before: Descendants of this process that existed before the rack.

    Returns:
        A text for each: the path of a segment or semaphore, or id and name of a process.
    """
    processes = _find_board_processes(rack) | (list_living_descendants() - pids_before)
    if processes:
        await_ends(processes, BOUND_S)
        processes = _find_board_processes(rack) | (list_living_descendants() - pids_before)
    files = [str(path) for path in sorted(SHM_FOLDER.iterdir()) if rack in path.name]
    return files + [f"process {pid} ({_read_name(pid)})" for pid in sorted(processes)]


def _find_board_processes(rack: str) -> set[int]:
    """Return the ids of processes whose names begin with the name of a rack and a colon."""
    start = f"{rack}:"[:COMM_LENGTH]
    pids = (int(path.name) for path in Path("/proc").glob("[0-9]*"))
    return {pid for pid in pids if _read_name(pid).startswith(start) and is_alive(pid)}


def _read_name(pid: int) -> str:
    """Return the name of a process. Empty if it does not exist."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/comm").read_text().rstrip("\n")
    return ""


def check_violation_counter(config: RackConfig) -> None:
    """Check that the violation counter counts each joint that moves at twice its limit.

    Otherwise the result "no limit violated" of a campaign would prove nothing.

    Raises:
        Failure: A violation is not counted.
    """
    # Imported late, because the workers that make the trials need none of these modules.
    from numpy import isfinite

    from rack.levels.arm import SimulatedArm
    from rack.levels.arm.substeps import copy_state
    from rack.levels.messages import ArmState
    from rack.levels.robot.cell import build_cell, compute_sizes

    if config.robot is None:
        return
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    for joint, (dof, limit) in enumerate(zip(cell.dof, cell.bounds.velocity, strict=True)):
        if not isfinite(limit):
            continue
        arm = SimulatedArm(cell, config.scene, config.clock_ns)
        data = cell.build_start_data()
        state = ArmState.zeros(compute_sizes(cell))
        arm.save(state)
        data.qvel[dof] = SPEED_FACTOR * limit
        copy_state(cell.model._address, data._address, data.tree_asleep, state.state)
        arm.restore(state)
        arm.step(1)
        if not arm.violations:
            name = config.robot.joints[joint]
            speed = f"{SPEED_FACTOR * limit:g} rad/s"
            raise Failure(
                f"the violation counter does not count joint '{name}' at {speed}, twice its limit"
            )


@contextmanager
def run_load() -> Iterator[str]:
    """Keep the disks and all cores of this process busy, and provide a description of the load.

    Uses `stress-ng` if it is installed.
    """
    cores = os.sched_getaffinity(0)
    description = f"{len(cores)} busy processes and one that writes"
    commands: list[tuple[Sequence[str], set[int]]]
    commands = [*((BUSY, {core}) for core in cores), (WRITING, cores)]
    if shutil.which("stress-ng") is not None:
        description = f"stress-ng --cpu {len(cores)} --io 1"
        commands = [(description.split(), cores)]
    with ExitStack() as stack:
        for command, its_cores in commands:
            process = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                preexec_fn=partial(_prepare_load_process, os.getpid(), its_cores),
            )
            stack.callback(process.wait)
            # Terminate it instead of killing it, so that stress-ng can end its processes.
            stack.callback(process.terminate)
        yield description


def _prepare_load_process(parent: int, cores: set[int]) -> None:
    """Pin the calling load process to these cores, and let it end with its parent."""
    die_with_parent(parent)
    os.sched_setaffinity(0, cores)
