"""Checks of the machine's limits during a launch, and the notes that the launch reports."""

from __future__ import annotations

from collections.abc import Iterator
from resource import RLIMIT_MEMLOCK, RLIMIT_NOFILE, getrlimit

from rack.backplane import exclusive_cores
from rack.backplane.process import DEADLINE, keep_cores_awake, read_memory_sizes, reserve_time
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Scheduler, System
from rack.boards.config.layout import list_replaced_cores
from rack.boards.config.resolved import Resolved
from rack.boards.config.rules import load_network_rules
from rack.boards.errors import LaunchError

_PERMIT = (
    "To allow it, add the line '@GROUP - {}' for one of your groups to /etc/security/limits.conf"
    " and log in again (ulimit -{} shows the limit), or grant {}"
)
PERMIT = _PERMIT.format("rtprio 99", "r", "CAP_SYS_NICE")
"""Advice on obtaining real-time priorities."""
EARLIEST = Scheduler.EARLIEST_DEADLINE_FIRST
FILES = 32
"""Files that a process of a rack may open, in addition to one for each process and mailbox."""


def check_open_files(plan: Resolved) -> None:
    """Raise `LaunchError` if the system permits too few open files for this rack."""
    needed = FILES + len(plan.layout.processes) + len(plan.layout.mailboxes)
    if 0 <= (allowed := getrlimit(RLIMIT_NOFILE)[0]) < needed:
        raise LaunchError(
            f"rack '{plan.config.name}': at most {allowed} open files are permitted (ulimit -n);"
            f" the rack needs {needed}"
        )


def check_realtime(plan: Resolved, segment: Segment) -> None:
    """Raise `LaunchError` if a scheduler was refused, or a priority that the config requires."""
    for task in plan.tasks:
        if (scheduling := task.scheduling) is None or scheduling.reservation is None:
            continue
        block = segment.get_block(task.task)
        if block[Block.SCHEDULER] != EARLIEST or block[Block.PRIORITY] == DEADLINE:
            continue
        # The board was refused. Ask once more for the reason.
        if why := reserve_time(scheduling.reservation, block[Block.PID]):
            raise LaunchError(
                f"board.{task.task}.scheduler: {EARLIEST.word} refused: {why}; otherwise use"
                " fixed-priority",
                2,
            )
    if plan.config.clock.on_no_realtime == "refuse" and (refusal := _find_refusal(plan, segment)):
        raise LaunchError(f'{refusal}, and clock.on_no_realtime is "refuse". {PERMIT}')


def reserve_cores(plan: Resolved, segment: Segment) -> Iterator[str]:
    """Give the rack its cores to itself if the config requires it.

    Yields:
        What came of it, or that a requested core is replaced.

    Raises:
        LaunchError: The system refuses, and the config requires that it does not.
    """
    # Reserved cores are not available to this process.
    yield from list_replaced_cores(plan.config)
    clock = plan.config.clock
    if not clock.exclusive_cores or plan.config.is_lockstep:
        return
    cores = {*plan.clock_cores, *(task.core for task in plan.layout.tasks)}
    text = f"cores {', '.join(map(str, sorted(cores)))}"
    if refusal := exclusive_cores.reserve_cores(plan.config.name, cores):
        why = f"clock.exclusive_cores refused: {refusal}"
        if clock.on_no_realtime == "refuse":
            raise LaunchError(f'{why}, and clock.on_no_realtime is "refuse"', 2)
        yield f"{why}; other processes may run on {text}"
    else:
        segment.words[System.EXCLUSIVE_CORES] = 1
        yield f"other processes are kept off {text}"


def list_launch_notes(plan: Resolved, segment: Segment) -> Iterator[str]:
    """Yield notes on refused priorities and other limits of this machine."""
    config = plan.config
    if (network := load_network_rules(config)) is not None:
        yield from network.list_network_notes(config)
    if config.is_lockstep:
        yield from (
            f"messages of {host.board} enter at ticks that depend on its timing; --entries RUN"
            " repeats a run"
            for host in plan.hosts
            if host.is_external
        )
        return
    if refusal := _find_refusal(plan, segment):
        yield f"{refusal}; missed deadlines are likely. {PERMIT}"
    reserved = [
        task.task for task in plan.tasks if segment.get_block(task.task)[Block.PRIORITY] == DEADLINE
    ]
    if reserved:
        yield f"earliest deadline first by SCHED_DEADLINE: {', '.join(sorted(reserved))}"
    unlocked = {}
    for task in plan.layout.tasks:
        mapped, locked = read_memory_sizes(segment.get_block(task.name)[Block.PID])
        if not locked:
            unlocked[task.name] = mapped
    if unlocked:
        yield (
            f"memory not locked for {', '.join(unlocked)}: the limit is"
            f" {getrlimit(RLIMIT_MEMLOCK)[0]} bytes, a board maps {max(unlocked.values())};"
            " page faults may delay cycles."
            f" {_PERMIT.format('memlock unlimited', 'l', 'CAP_IPC_LOCK')}"
        )
    if config.clock.idle_cores == "awake":
        with keep_cores_awake() as refusal:
            yield f'clock.idle_cores = "awake": {refusal or "idle cores are held awake"}'


def _find_refusal(plan: Resolved, segment: Segment) -> str:
    """Return a clause that names the tasks whose real-time priority was refused.

    The clause is empty in lockstep, or if no priority was refused.
    """
    refused = [
        task.name
        for task in plan.layout.tasks
        if task.priority and not segment.get_block(task.name)[Block.PRIORITY]
    ]
    if not refused or plan.config.is_lockstep:
        return ""
    return f"SCHED_FIFO refused, ordinary scheduling for {', '.join(refused)}"
