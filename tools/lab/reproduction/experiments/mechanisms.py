"""Mechanisms that the paper names for its systems, measured in recordings of whole tasks.

Measurements are keyed by name, with the unit at the end, as the page shows them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from rack.backplane.layout import MailboxSpec
from rack.boards.config import build_rack_timing
from rack.boards.timing.trace_times import count_skipped_releases, find_newest_visible
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


WAYS = ("entries_in", "entries_out")
MODES = ("entries_asynchronous", "entries_every_cycle", "entries_every_nth_cycle")


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
    cycles = np.concatenate([recording.read_trace(task.name) for task in layout.tasks])
    left_ns = (minor - cycles["tick"] % minor) * layout.clock_ns
    # In lockstep a cycle may take any real time.
    is_late = (cycles["end_ns"] > cycles["release_ns"] + left_ns) & (not rack.is_lockstep)
    skipped = count_skipped_releases(cycles).sum()
    levels = {board for chain in rack.chains for board in chain}
    ages = [
        Counter(_list_ages(recording, box, reader))
        for box in layout.timed
        for reader in levels.intersection(box.readers) - {box.writer}
        if box.writer in levels
    ]
    return {
        "frames": cycles["tick"].max(initial=0) // minor * bool(rack.schedule),
        "cycles_outside_frame_share": (is_late.sum() + skipped) / max(len(cycles) + skipped, 1),
        "locked_mailboxes": sum(box.protocol == "lock" for box in layout.mailboxes),
        "ages_off_share": sum(each.total() - max(each.values(), default=0) for each in ages)
        / max(sum(each.total() for each in ages), 1),
    }


def _list_ages(recording: Recording, box: MailboxSpec, reader: str) -> list[int]:
    """Return the age in ticks of each message of a mailbox when a task first reads it."""
    every, phase = recording.layout.find_read_grid(box, reader)
    ticks = recording.read_trace(reader)["tick"]
    ticks = ticks[ticks % every == phase]
    newest = find_newest_visible(ticks, recording.read_signal(box.name, "visible_at"))
    is_first = np.diff(newest, prepend=-1) > 0
    made = recording.read_signal(box.name, "tick")[newest[is_first]]
    return list((ticks[is_first] - made).tolist())


def _measure_queue(recording: Recording) -> dict[str, float]:
    """Measure RCCL's queue, the speed between its motions, and the distance from a live goal."""
    numbers, kinds = (recording.read_signal("planning.plan", name) for name in ("id", "kind"))
    current, done, taken, velocity, tool, astray = (
        recording.read_signal("trajectory.status", name).astype(float)
        for name in ("current", "done", "taken", "velocity", "tool", "astray")
    )
    is_moving = np.isin(current, numbers[np.isin(kinds, MOTION_KINDS)])
    is_blend = is_moving[1:] & is_moving[:-1] & (np.diff(current) > 0)
    speeds = np.linalg.norm(velocity[1:][is_blend], axis=1)
    is_tracking = astray > 0
    steps_m = np.linalg.norm(np.diff(tool[is_tracking], axis=0), axis=1)
    return {
        "requests_queued": (taken - np.maximum(current, done)).max(initial=0),
        "blends": len(speeds),
        "slowest_blend_rad_s": min(speeds, default=0.0),
        "live_goal_followed_m": steps_m.sum(),
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
    counts: dict[str, float] = dict.fromkeys((*WAYS, *MODES), 0)
    for status, name, source in list_entries(recording.layout, recording.config):
        passed = recording.read_signal(status, f"{name}.passed")
        distances = np.diff(np.flatnonzero(np.diff(passed, prepend=0)))
        usual = np.median(distances) if len(distances) else 0
        is_periodic = len(distances) and (distances != usual).mean() <= MAX_IRREGULAR_SHARE
        if passed.any():
            counts[WAYS[source in recording.mailboxes]] += 1
            counts[MODES[min(int(usual), 2) if is_periodic else 0]] += 1
    return counts


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
    """Measure CONDOR's adapter, and the effect of its workstation on the hand."""
    plan, touching = (
        recording.read_signal("coordinator.status", name) for name in ("plan", "touching")
    )
    return _measure_adapter(recording) | {
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
