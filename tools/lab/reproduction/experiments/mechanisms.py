"""Mechanisms that the paper names for its systems, measured in recordings of whole tasks.

Measurements are keyed by name, with the unit at the end, as the page shows them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from rack.boards.config import build_rack_timing
from rack.boards.timing.trace_times import count_misses_and_skips, find_newest_visible
from rack.levels.systems.trajectory.messages import MotionKind
from rack.tools.monitor.host_side import list_entries
from rack.tools.recording.recording import Recording

MOTION_KINDS = (MotionKind.JOINTS, MotionKind.POSE)
SLIDING_M_S = 0.005
"""Speed above which a tool in contact slides. A tool that only presses is slower."""
FORCE_PERCENTILE = 90.0
"""Percentile of force errors. The rest of the path leads over an edge and to a wall."""
MAX_IRREGULAR_SHARE = 0.02
"""Largest share of a periodic entry's steps that come at another distance than usual."""


def measure_levels(recording: Recording) -> tuple[int, ...]:
    """Return the numbers of cycles of the longest chain of levels, from the highest level down.

    It is a chain of closed loops: a status echoes a command, or a command depends on a status.
    """
    longest: tuple[int, ...] = ()
    for chain in build_rack_timing(recording.rack_config, recording.layout).chains:
        levels = [chain[0]]
        for upper, lower in pairwise(chain):
            is_closed = (
                _find_largest(recording, f"{lower}.status", "echo") > 0
                or _find_largest(recording, f"{upper}.command", "sampled") >= 0
            )
            levels = [*levels * is_closed, lower]
            longest = max(longest, tuple(len(recording.read_trace(b)) for b in levels), key=len)
    return longest


def _find_largest(recording: Recording, mailbox: str, field: str) -> int:
    """Return the largest value of a field in the messages of a mailbox. -1 without any."""
    if mailbox not in recording.mailboxes or field not in recording.list_fields(mailbox):
        return -1
    return int(recording.read_signal(mailbox, field).max())


def _measure_schedule(recording: Recording) -> dict[str, float]:
    """Measure HIC's frames and protocols, and the ages of data when a level first reads them."""
    layout = recording.layout
    rack = build_rack_timing(recording.rack_config, layout)
    minor = rack.schedule.minor if rack.schedule else 1
    rows = {task.name: recording.read_trace(task.name) for task in layout.tasks}
    outside = 0
    for cycles in rows.values():
        left_ns = (minor - cycles["tick"] % minor) * layout.clock_ns
        # In lockstep a cycle may take any real time.
        is_late = (cycles["end_ns"] > cycles["release_ns"] + left_ns) & (not rack.is_lockstep)
        outside += int(is_late.sum()) + count_misses_and_skips(cycles)[1]
    levels = {board for chain in rack.chains for board in chain}
    ages = [
        Counter(_compute_ages(recording, box.name, reader).tolist())
        for box in layout.timed
        for reader in box.readers
        if {box.writer, reader} <= levels and box.writer != reader
    ]
    taken = sum(each.total() for each in ages)
    usual = sum(max(each.values(), default=0) for each in ages)
    return {
        "frames": recording.end_counts["outcome"]["ticks"] // minor * bool(rack.schedule),
        "cycles_outside_frame_share": outside / max(sum(map(len, rows.values())), 1),
        "locked_mailboxes": sum(box.protocol == "lock" for box in layout.mailboxes),
        "messages_taken_over": taken,
        "ages_off_share": 1.0 - usual / max(taken, 1),
    }


def _compute_ages(recording: Recording, mailbox: str, reader: str) -> np.ndarray:
    """Return the age in ticks of each message of a mailbox when a task first reads it."""
    layout = recording.layout
    every, phase = layout.find_read_grid(layout.find_mailbox(mailbox), reader)
    ticks = recording.read_trace(reader)["tick"]
    ticks = ticks[(ticks - phase) % every == 0]
    newest = find_newest_visible(ticks, recording.read_signal(mailbox, "visible_at"))
    is_first = (newest >= 0) & (np.diff(newest, prepend=-1) > 0)
    return np.asarray(ticks[is_first] - recording.read_signal(mailbox, "tick")[newest[is_first]])


def _measure_queue(recording: Recording) -> dict[str, float]:
    """Measure RCCL's queue, the speed between its motions, and the distance from a live goal."""
    numbers, kinds = (recording.read_signal("planning.plan", name) for name in ("id", "kind"))
    moving = numbers[np.isin(kinds, MOTION_KINDS)]
    current, done, taken, velocity, tool, astray = (
        recording.read_signal("trajectory.status", name)
        for name in ("current", "done", "taken", "velocity", "tool", "astray")
    )
    speed = np.linalg.norm(velocity, axis=1)
    blends = []
    for pair in pairwise(np.unique(current[current > 0]).tolist()):
        if np.isin(pair, moving).all():
            # From the fastest point of one motion to that of the next.
            first, last = (np.where(current == each, speed, -1.0).argmax() for each in pair)
            blends.append(speed[first : last + 1].min() / max(min(speed[[first, last]]), 1e-9))
    steps_m = np.linalg.norm(np.diff(tool, axis=0, prepend=tool[:1]), axis=1)
    is_tracking = astray > 0
    return {
        "requests_queued": (taken - np.maximum(current, done).astype(int)).max(initial=0),
        "blends": len(blends),
        "slowest_in_blend_share": min(blends, default=0.0),
        "live_goal_followed_m": steps_m[is_tracking].sum(),
        "live_goal_astray_m": np.median(astray[is_tracking]) if is_tracking.any() else 0.0,
    }


def _measure_force(recording: Recording) -> dict[str, float]:
    """Measure the requests to Penn's server, and its contact forces against the commanded ones."""
    kinds = recording.read_signal("bridge.requests", "kind")
    wrench, wanted, selected, place = (
        recording.read_signal("server.status", name)
        for name in ("wrench", "wanted", "selected", "place")
    )
    period_s = recording.layout.find_task("server").every * recording.layout.clock_ns * 1e-9
    steps_m = np.linalg.norm(np.diff(place, axis=0, prepend=place[:1]), axis=1)
    is_sliding = steps_m > SLIDING_M_S * period_s
    pressed = (selected == 1) & (wanted != 0) & is_sliding[:, None]
    errors = np.abs(wrench / np.where(pressed, wanted, 1.0) - 1.0)[pressed]
    return {
        "motion_requests": np.isin(kinds, MOTION_KINDS).sum(),
        "force_requests": (kinds == MotionKind.COMPLY).sum(),
        "slid_under_force_s": pressed.any(axis=1).sum() * period_s,
        "force_error_share": np.percentile(errors, FORCE_PERCENTILE) if len(errors) else 0.0,
    }


def _measure_adapter(recording: Recording) -> dict[str, float]:
    """Count the entries of a bus adapter or bridge, by the cycles in which they pass messages."""
    hosts = {host.name for host in recording.layout.hosts}
    kinds: Counter[str] = Counter()
    for status, name, source in list_entries(recording.layout, recording.config):
        steps = np.flatnonzero(np.diff(recording.read_signal(status, f"{name}.passed"), prepend=0))
        way = "in" if recording.layout.find_mailbox(source).writer in hosts else "out"
        distances = Counter(np.diff(steps).tolist())
        usual, count = max(distances.items(), key=lambda item: item[1], default=(0, 0))
        is_periodic = count >= max((1.0 - MAX_IRREGULAR_SHARE) * distances.total(), 1)
        when = "asynchronous" if not is_periodic else "every" if usual == 1 else "nth"
        kinds.update({way: 1, when: 1, f"{when}_{way}": 1} if len(steps) else {})
    return {
        "entries_in": kinds["in"],
        "entries_out": kinds["out"],
        "entries_every_cycle": kinds["every"],
        "entries_every_nth_cycle": kinds["nth"],
        "entries_asynchronous": kinds["asynchronous"],
        "entries_in_periodic": kinds["every_in"] + kinds["nth_in"],
        "entries_out_periodic": kinds["every_out"] + kinds["nth_out"],
    }


def _measure_hosted_motion(recording: Recording) -> dict[str, float]:
    """Measure a bridge, and how the level below it served the requests of a host board."""
    (level,) = recording.rack_config.board["bridge"].below
    due = recording.read_signal(f"{level}.command", "due")
    sent = max(_find_largest(recording, "bridge.requests", "id"), 0)
    return _measure_adapter(recording) | {
        "requests": sent,
        "requests_not_ended": sent - _find_largest(recording, f"{level}.status", "done"),
        "cycles_without_set_point_share": 1.0
        - len(np.unique(due[due > 0])) / max(len(recording.read_trace(level)), 1),
    }


def _measure_hosted_grasp(recording: Recording) -> dict[str, float]:
    """Measure CONDOR's adapter, and what its workstation and its boards did with the hand."""
    plan, touching = (
        recording.read_signal("coordinator.status", name) for name in ("plan", "touching")
    )
    drives = [
        recording.read_signal(name, "driven").any()
        for name in recording.mailboxes
        if "hand" in recording.layout.find_mailbox(name).readers
        and "driven" in recording.list_fields(name)
    ]
    return _measure_adapter(recording) | {
        "boards_driving_hand": sum(drives),
        "fingers_on_planned_grasp": (touching.sum(axis=1) * (plan > 0)).max(initial=0),
    }


MEASURES: dict[str, Callable[[Recording], dict[str, float]]] = {
    "chimera": _measure_hosted_motion,
    "condor": _measure_hosted_grasp,
    "hic": _measure_schedule,
    "ibm": _measure_hosted_motion,
    "penn": _measure_force,
    "rccl": _measure_queue,
}
"""Functions that measure the mechanism of a system, by the name of its rack."""


def measure_mechanism(name: str, recording: Recording) -> dict[str, float]:
    """Measure the mechanism of a system. Empty for a system without one."""
    if name not in MEASURES:
        return {}
    return {key: float(value) for key, value in MEASURES[name](recording).items()}
