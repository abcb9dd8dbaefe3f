"""Cores that a rack has to itself: a cgroup (version 2) with one core, which is a cpuset partition.

The kernel keeps all other processes off the core of a partition, and balances no load with it. The
groups are children of the root of the hierarchy, as a partition requires. They are removed with the
rack. Groups of a rack that was killed are removed by the next launch of the rack or `rack clean`.

https://docs.kernel.org/admin-guide/cgroup-v2.html#cpuset
"""

from __future__ import annotations

import select
from collections.abc import Collection, Iterable
from contextlib import suppress
from pathlib import Path

MOUNTS = Path("/proc/self/mounts")
CONTROLLER = "cpuset"


def find_hierarchy() -> Path | None:
    """Return the folder of the cgroup hierarchy, version 2. None if it is not mounted."""
    rows = map(str.split, MOUNTS.read_text().splitlines())
    return next((Path(folder) for _, folder, kind, *_ in rows if kind == "cgroup2"), None)


def reserve_cores(rack: str, cores: Iterable[int]) -> str:
    """Keep all processes that do not enter them off some cores.

    Args:
        rack: Name of the rack.
        cores: The cores.

    Returns:
        Why the system refuses. In that case no core is reserved. Empty if it does not.
    """
    root = find_hierarchy()
    if root is None:
        return "no cgroup hierarchy of version 2 is mounted"
    release_cores(rack)
    try:
        if CONTROLLER not in (root / "cgroup.controllers").read_text().split():
            return f"{root} has no controller {CONTROLLER}"
        (root / "cgroup.subtree_control").write_text(f"+{CONTROLLER}")
        for core in sorted(set(cores)):
            group = root / f"rack.{rack}.{core}"
            group.mkdir()
            (group / "cpuset.cpus").write_text(str(core))
            partition = group / "cpuset.cpus.partition"
            partition.write_text("root")
            # The kernel accepts the word, and reports here what prevents the partition.
            if (state := partition.read_text().strip()) != "root":
                raise OSError(f"core {core}: {state}")
    except OSError as error:
        release_cores(rack)
        return str(error)
    return ""


def enter_core(rack: str, core: int) -> None:
    """Move the calling process to a core that `reserve_cores` has reserved."""
    if (root := find_hierarchy()) is not None:
        (root / f"rack.{rack}.{core}" / "cgroup.procs").write_text("0")


def release_cores(rack: str = "*", in_use: Collection[str] = (), wait_s: float = 0.0) -> None:
    """Release the cores of a rack, or of all racks, whose processes have ended.

    Args:
        rack: Name of the rack. By default all racks.
        in_use: Names of racks that keep their cores.
        wait_s: Longest time to wait for the processes on each core.
    """
    if (root := find_hierarchy()) is not None:
        for group in root.glob(f"rack.{rack}.*"):
            if group.name.split(".")[1] not in in_use:
                with suppress(OSError):
                    _await_empty(group, wait_s)
                    group.rmdir()


def _await_empty(group: Path, wait_s: float) -> None:
    """Wait until no process is in a group, or the time is over."""
    if not wait_s:
        return
    with (group / "cgroup.events").open() as events:
        changes = select.poll()
        changes.register(events, select.POLLPRI)
        while "populated 1" in events.read() and changes.poll(wait_s * 1000):
            events.seek(0)
