"""What a run of a rack in real time has shown: ages of messages, plans, accesses to the bus,
processor time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rack.backplane.layout import Layout, TaskSpec
from rack.levels.timing.rack import RackTiming
from rack.levels.timing.system_response import mailboxes_along
from rack.levels.timing.trace_times import Distribution, distribution, newest_visible
from rack.tools.lab.benches.observed import CycleCount
from rack.tools.live.host_side import entries_of
from rack.tools.live.launch import RunResult
from rack.tools.recording.cycles import Cycles
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.analysis import task_loads


@dataclass(frozen=True)
class BusTraffic:
    """Accesses to mailboxes a second of simulated time, and bytes of messages; both reads and
    writes."""

    accesses: float
    bytes: float


@dataclass(frozen=True)
class PlanLatency:
    """How long what one maker has planned takes until the level below can use it, ms.

    `latency_ms`: of a planner from the release that begins a plan to the tick from which the plan
    is visible, of a host board from sending an order to the tick from which levels see it.
    `computed_ms`: the processor time of a plan; None of a host board, which is not traced. `made`
    counts them.
    """

    maker: str
    made: int
    latency_ms: Distribution
    computed_ms: Distribution | None


def cycles_in(run: RunResult, board: str) -> CycleCount:
    """Count the cycles of a board in a run: those missed or skipped, and those due."""
    counted = run.tasks[board]
    return CycleCount(counted["missed"] + counted["skipped"], counted["due"])


def bus_traffic(
    counts: Mapping[str, Mapping[str, int]], ticks: int, layout: Layout
) -> dict[str, BusTraffic]:
    """Return the traffic of every board on the bus, with that of its planner; `counts` as in
    `RunResult.tasks`."""
    lasted_s = ticks * layout.clock_ns * 1e-9
    found: dict[str, BusTraffic] = {}
    for task in layout.tasks:
        counted = counts[task.name]
        before = found.get(task.board, BusTraffic(0.0, 0.0))
        found[task.board] = BusTraffic(
            before.accesses + (counted["reads"] + counted["writes"]) / lasted_s,
            before.bytes + (counted["read_bytes"] + counted["write_bytes"]) / lasted_s,
        )
    return found


def board_loads(
    recording: Recording, cycles: Mapping[str, Cycles], timing: RackTiming
) -> dict[str, float]:
    """Return the part of a core's time that every board used, with its planner."""
    found: dict[str, float] = {}
    for name, load in task_loads(recording, cycles, timing).items():
        board = recording.layout.task(name).board
        found[board] = found.get(board, 0.0) + load
    return found


def plan_latencies(recording: Recording, cycles: Mapping[str, Cycles]) -> tuple[PlanLatency, ...]:
    """Return the latencies of every planner that made plans, and of every host board whose orders
    entered."""
    tasks = [task for task in recording.layout.tasks if task.role == "planner"]
    found = [_of_planner(recording, task, cycles.get(task.name)) for task in tasks]
    found += _of_hosts(recording)
    return tuple(one for one in found if one is not None)


def _of_planner(
    recording: Recording, planner: TaskSpec, cycles: Cycles | None
) -> PlanLatency | None:
    box = f"{planner.board}.plan"
    if cycles is None or box not in recording.mailboxes:
        return None
    made = recording.signal(box, "tick")
    visible_at = recording.signal(box, "visible_at")
    # A queue's plan is several messages: the release that made them counts once.
    made, first = np.unique(made, return_index=True)
    latency_ms = distribution((visible_at[first] - made) * recording.layout.clock_ns * 1e-6)
    computed_ms = distribution(cycles.used_ns * 1e-6)
    return (
        None
        if latency_ms is None
        else PlanLatency(planner.name, len(made), latency_ms, computed_ms)
    )


def _of_hosts(recording: Recording) -> Iterator[PlanLatency]:
    """Yield the time that orders of host boards took through a bridge: in its ring, then until
    levels see them."""
    layout = recording.layout
    tick_ms = recording.layout.clock_ns * 1e-6
    hosts = {host.name for host in layout.hosts}
    for status, entry, source in entries_of(layout, recording.config):
        bridge = status.partition(".")[0]
        if source.partition(".")[0] not in hosts or status not in recording.mailboxes:
            continue
        passed = recording.signal(status, f"{entry}.passed")
        age = recording.signal(status, f"{entry}.age")
        entered = np.flatnonzero(np.diff(passed, prepend=0) > 0)
        latency_ms = distribution((age[entered] + layout.task(bridge).every) * tick_ms)
        if latency_ms is not None:
            yield PlanLatency(source.partition(".")[0], int(passed[-1]), latency_ms, None)


def ages_ms(recording: Recording, timing: RackTiming, down: bool) -> Distribution | None:
    """Return the age of commands in the cycles of the lowest levels, or of their statuses in those
    above, ms.

    An age is the time since the release that wrote the message. None if there is no such message.
    """
    pairs = dict.fromkeys(
        chain[-2:] if down else chain[:-3:-1] for chain in timing.hierarchy.chains
    )
    found = [ages for writer, reader in pairs for ages in _ages(recording, writer, reader)]
    return distribution(np.concatenate(found) * timing.clock_ns * 1e-6) if found else None


def _ages(recording: Recording, writer: str, reader: str) -> Iterator[np.ndarray]:
    """Yield the ages in ticks of what one board has of another, cycle by cycle."""
    cycles: np.ndarray = recording.cycles[reader]["tick"]
    for box in mailboxes_along(recording.layout, (writer, reader)):
        made = recording.signal(box.name, "tick")
        visible_at = recording.signal(box.name, "visible_at")
        grid = recording.layout.read_grid(box, reader)
        # Between two reads the message of the last one grows older.
        since = (cycles - grid.phase) % grid.every
        newest = newest_visible(cycles - since, visible_at)
        yield cycles[newest >= 0] - made[newest[newest >= 0]]
