"""Cores that a rack has to itself, in a folder with the files of the kernel's cgroup hierarchy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rack.backplane import exclusive_cores
from rack.backplane.exclusive_cores import enter_core, release_cores, reserve_cores

PARTITION = "cpuset.cpus.partition"


@pytest.fixture
def hierarchy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A hierarchy with the controller `cpuset`, whose folders are removed as the kernel does."""
    root = tmp_path / "cgroup"
    root.mkdir()
    (root / "cgroup.controllers").write_text("cpuset cpu io\n")
    mounts = tmp_path / "mounts"
    mounts.write_text(f"proc /proc proc rw 0 0\ncgroup2 {root} cgroup2 rw 0 0\n")
    monkeypatch.setattr(exclusive_cores, "MOUNTS", mounts)

    def remove(folder: Path) -> None:
        if (folder / "cgroup.procs").exists():
            raise OSError(16, "Device or resource busy")
        shutil.rmtree(folder)

    monkeypatch.setattr(Path, "rmdir", remove)
    return root


def list_groups(root: Path) -> list[str]:
    return sorted(path.name for path in root.iterdir() if path.is_dir())


def test_each_core_is_a_partition_that_its_tasks_enter(hierarchy: Path) -> None:
    assert reserve_cores("arm", [1, 0, 1]) == ""
    assert list_groups(hierarchy) == ["rack.arm.0", "rack.arm.1"]
    assert (hierarchy / "cgroup.subtree_control").read_text() == "+cpuset"
    group = hierarchy / "rack.arm.1"
    assert [(group / name).read_text() for name in ("cpuset.cpus", PARTITION)] == ["1", "root"]
    enter_core("arm", 1)
    assert (group / "cgroup.procs").read_text() == "0"
    release_cores("arm")
    # The kernel keeps the group in which a process is.
    assert list_groups(hierarchy) == ["rack.arm.1"]


def test_groups_of_a_killed_rack_are_replaced_or_removed(hierarchy: Path) -> None:
    for name in ("arm", "hand", "arm-2"):
        assert reserve_cores(name, [0]) == ""
    assert reserve_cores("arm", [1]) == ""
    assert list_groups(hierarchy) == ["rack.arm-2.0", "rack.arm.1", "rack.hand.0"]
    release_cores(in_use=["hand"])
    assert list_groups(hierarchy) == ["rack.hand.0"]


REFUSAL = "root invalid (Parent unable to distribute cpu downstream)"


def test_a_refused_partition_leaves_no_group(
    hierarchy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_text = Path.read_text

    def read(path: Path) -> str:
        is_refused = path == hierarchy / "rack.arm.1" / PARTITION
        return f"{REFUSAL}\n" if is_refused else read_text(path)

    monkeypatch.setattr(Path, "read_text", read)
    assert reserve_cores("arm", [0, 1]) == f"core 1: {REFUSAL}"
    assert list_groups(hierarchy) == []


@pytest.mark.parametrize(
    ("controllers", "mounted", "refusal"),
    [
        ("cpu io", True, "{root} has no controller cpuset"),
        ("cpuset", False, "no cgroup hierarchy of version 2 is mounted"),
        (None, True, "[Errno 2] No such file or directory: '{root}/cgroup.controllers'"),
    ],
)
def test_a_machine_without_partitions_says_why(
    hierarchy: Path, controllers: str | None, mounted: bool, refusal: str
) -> None:
    (hierarchy / "cgroup.controllers").unlink()
    if controllers is not None:
        (hierarchy / "cgroup.controllers").write_text(controllers)
    if not mounted:
        exclusive_cores.MOUNTS.write_text("proc /proc proc rw 0 0\n")
    assert reserve_cores("arm", [0]) == refusal.format(root=hierarchy)
    release_cores("arm")
    assert list_groups(hierarchy) == []
