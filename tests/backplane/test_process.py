"""Processes are identified by pid and start time."""

from __future__ import annotations

import errno
import gc
import os
import resource
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from io import TextIOWrapper
from pathlib import Path

import pytest

from rack.backplane.memory import hold_memory
from rack.backplane.process import (
    DEADLINE,
    ENDED_STATES,
    STOPPED_STATES,
    WAITING_STATES,
    Reservation,
    busy_wait_until,
    describe_end,
    describe_refusal,
    die_with_parent,
    disable_timer_slack,
    is_alive,
    is_ending,
    keep_cores_awake,
    list_children,
    name_process,
    read_memory_sizes,
    read_processor_ns,
    read_state,
    set_priority,
    take_core,
    wait_readable,
    write_line,
)
from tests.machine import needs_deadlines, needs_fifo
from tests.processes import FORKS, descriptors, exit_status, fork, forked, wait_until

pytestmark = pytest.mark.filterwarnings(FORKS)


def test_a_killed_process_is_ending_before_it_has_ended() -> None:
    """It first frees its memory, and is in state R meanwhile."""

    def fill() -> None:
        memory = bytearray(b"x") * 400_000_000
        time.sleep(60)
        assert memory

    with forked(fill) as pid:
        wait_until(lambda: read_memory_sizes(pid)[0] > 400_000_000)
        assert not is_ending(pid)
        os.kill(pid, signal.SIGKILL)
        before = []
        while not is_ending(pid):
            before.append(read_state(pid))
        assert not set(before) & set(ENDED_STATES)
        wait_until(lambda: read_state(pid) in ENDED_STATES)
        assert is_ending(pid)


def test_a_process_name_may_contain_parentheses_and_spaces() -> None:
    def rename() -> None:
        name_process(") S 1 (x) 2")
        time.sleep(60)

    with forked(rename) as pid:
        wait_until(lambda: ") S 1" in Path(f"/proc/{pid}/comm").read_text())
        assert read_state(pid) in WAITING_STATES


def test_cores_are_kept_awake_by_a_request_that_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = tmp_path / "cpu_dma_latency"
    monkeypatch.setattr("rack.backplane.process.LATENCY_REQUEST", device)
    with keep_cores_awake() as refusal:
        assert refusal == (
            f"idle cores sleep, because {device} cannot be opened: No such file or directory"
        )
    assert not device.exists()
    device.touch()
    before = descriptors()
    with keep_cores_awake() as refusal:
        assert refusal == ""
        assert device.read_bytes() == bytes(4)
        assert descriptors() == before + 1
    assert descriptors() == before


def test_the_kernel_says_in_which_state_a_process_is() -> None:
    assert read_state(os.getpid()) == "R"
    assert [is_alive(pid) for pid in (os.getpid(), 0, -1)] == [True, False, False]
    with forked(signal.pause) as pid:
        wait_until(lambda: read_state(pid) in WAITING_STATES)
        os.kill(pid, signal.SIGSTOP)
        wait_until(lambda: read_state(pid) in STOPPED_STATES)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: read_state(pid) in ENDED_STATES)
        assert read_state(pid) == "Z"
        assert not is_alive(pid)
    assert (read_state(pid), read_processor_ns(pid), read_memory_sizes(pid)) == ("X", 0, (0, 0))


def test_processor_time_excludes_other_processes() -> None:
    target = time.process_time_ns() + 30_000_000
    busy_wait_until(target)
    used = time.process_time_ns()
    assert used >= target
    # The kernel counts in steps of 10 ms.
    assert abs(read_processor_ns(os.getpid()) - used) < 25_000_000


def test_a_descriptor_is_waited_for_within_a_bound() -> None:
    reading, writing = os.pipe()
    try:
        began = time.monotonic()
        assert not wait_readable(reading, 0.02)
        assert time.monotonic() - began >= 0.02
        assert not wait_readable(reading, -1.0)
        os.write(writing, b"x")
        assert wait_readable(reading, 0.0)
    finally:
        os.close(reading)
        os.close(writing)


def test_a_refusal_names_the_limit_that_is_reached() -> None:
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    processes = resource.getrlimit(resource.RLIMIT_NPROC)[0]
    text = describe_refusal(OSError(errno.EMFILE, "Too many"))
    assert text == f"Too many: the limit is {files} open files (ulimit -n)"
    text = describe_refusal(OSError(errno.EAGAIN, "Not now"))
    assert text == f"Not now: the limit is {processes} processes (ulimit -u)"
    assert describe_refusal(OSError(errno.EACCES, "No")) == f"[Errno {errno.EACCES}] No"


def test_a_status_says_how_a_process_ended() -> None:
    assert [describe_end(status) for status in (0, 3, -9)] == [
        "exit status 0",
        "exit status 3",
        "signal SIGKILL",
    ]


@needs_fifo
def test_a_task_takes_its_core_its_priority_and_its_memory() -> None:
    core = min(os.sched_getaffinity(0))

    def take() -> bool:
        assert take_core(core, 5, None) == 5
        hold_memory(lockstep=False)
        assert os.sched_getaffinity(0) == {core}
        mapped, locked = read_memory_sizes(os.getpid())
        assert mapped >= locked > 0
        return os.sched_getparam(0).sched_priority == 5

    def take_for_lockstep() -> bool:
        hold_memory(lockstep=True)
        return not gc.isenabled() and read_memory_sizes(os.getpid())[1] == 0

    def be_ordinary() -> bool:
        assert take_core(core, 0, None) == 0
        disable_timer_slack()
        return Path("/proc/self/timerslack_ns").read_text().strip() == "1"

    assert exit_status(fork(take)) == 0
    assert exit_status(fork(take_for_lockstep)) == 0
    assert exit_status(fork(be_ordinary)) == 0


@needs_deadlines
def test_a_reservation_applies_to_the_process_on_its_core() -> None:
    cores = os.sched_getaffinity(0)

    def take() -> bool:
        assert take_core(min(cores), 5, Reservation(100_000, 10_000_000)) == DEADLINE
        assert os.sched_getaffinity(0) == {min(cores)}
        assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == 6  # SCHED_DEADLINE
        # The kernel refuses a fork that would double what is reserved.
        child = fork(lambda: os.sched_getscheduler(0) == os.SCHED_OTHER)
        return exit_status(child) == 0 and set_priority(0)

    assert exit_status(fork(take)) == 0


@needs_fifo
def test_without_the_reservation_a_process_is_pinned_and_has_its_priority() -> None:
    core = max(os.sched_getaffinity(0))

    def take() -> bool:
        # More than there is: refused on every machine.
        assert take_core(core, 5, Reservation(2_000_000, 1_000_000)) == 5
        assert os.sched_getaffinity(0) == {core}
        return os.sched_getscheduler(0) == os.SCHED_FIFO

    assert exit_status(fork(take)) == 0


def test_a_child_dies_with_its_parent() -> None:
    reading, writing = os.pipe()

    def parent() -> None:
        me = os.getpid()

        def child() -> None:
            die_with_parent(me)
            os.write(writing, str(os.getpid()).encode())
            signal.pause()

        fork(child)
        signal.pause()

    with forked(parent) as pid:
        child = int(os.read(reading, 20))
        assert child in list_children(pid)
        assert is_alive(child)
    wait_until(lambda: not is_alive(child))
    # One that is started too late ends at once.
    assert exit_status(fork(lambda: die_with_parent(1))) == 1
    os.close(reading)
    os.close(writing)


def test_lines_of_several_threads_stay_whole(tmp_path: Path) -> None:
    """As boards print, which run under `python -u`, into the one file of their crate."""
    path = tmp_path / "printed"
    names = [str(number) * 20 for number in range(8)]
    with (
        TextIOWrapper(path.open("wb", buffering=0), write_through=True) as file,
        ThreadPoolExecutor(8) as threads,
    ):

        def print_often(name: str) -> None:
            for _ in range(300):
                write_line(file, name)

        list(threads.map(print_often, names))
    assert sorted(path.read_text().splitlines()) == sorted(names * 300)
