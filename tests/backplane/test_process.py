"""Processes are identified by pid and start time."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from rack.backplane.process import cores_kept_awake, is_alive, name_process, pin, start_time
from tests.processes import FORKS, descriptors, exit_status, fork, forked, kill, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)


def test_a_running_process_is_alive_under_its_own_start_alone() -> None:
    started = start_time(os.getpid())
    assert started > 0
    assert is_alive(os.getpid())
    assert is_alive(os.getpid(), started)
    assert not is_alive(os.getpid(), started + 1)


@pytest.mark.parametrize("pid", [0, -1])
def test_no_process_is_not_alive(pid: int) -> None:
    assert not is_alive(pid)


def test_a_killed_process_is_not_alive_even_before_it_is_reaped() -> None:
    with forked(lambda: time.sleep(60)) as pid:
        assert is_alive(pid)
        os.kill(pid, 9)
        wait_until(lambda: not is_alive(pid))
    assert not is_alive(pid)


def test_a_name_with_parentheses_and_spaces_does_not_confuse() -> None:
    def rename() -> None:
        name_process(") S 1 (x) 2")
        time.sleep(60)

    with forked(rename) as pid:
        before = start_time(pid)
        wait_until(lambda: ") S 1" in Path(f"/proc/{pid}/comm").read_text())
        assert start_time(pid) == before > 0


def test_a_process_is_pinned_to_one_core() -> None:
    core = max(os.sched_getaffinity(0))

    def pinned() -> bool:
        pin(core)
        return os.sched_getaffinity(0) == {core}

    assert exit_status(fork(pinned)) == 0


def test_a_core_that_the_machine_lacks_is_an_error() -> None:
    def lacking() -> None:
        with pytest.raises(OSError, match="Invalid argument"):
            pin(1023)

    child = fork(lacking)
    try:
        assert exit_status(child) == 0
    finally:
        kill(child)


@pytest.mark.slow
def test_cores_are_kept_awake_by_a_request_that_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = tmp_path / "cpu_dma_latency"
    device.touch()
    monkeypatch.setattr("rack.backplane.process.LATENCY_REQUEST", device)
    before = descriptors()
    with cores_kept_awake() as refusal:
        assert refusal == ""
        assert device.read_bytes() == bytes(4)
        assert descriptors() == before + 1
    assert descriptors() == before


def test_cores_sleep_as_usual_where_the_request_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rack.backplane.process.LATENCY_REQUEST", tmp_path / "missing")
    reason = ""
    with cores_kept_awake() as refusal:
        reason = refusal
    assert (
        reason
        == f"idle cores sleep, since {tmp_path / 'missing'} cannot be opened: No such file or"
        " directory"
    )
    assert not (tmp_path / "missing").exists()
