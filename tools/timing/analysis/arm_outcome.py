"""What the task, its objects and the arm or hand did, from a recording, as a report's data."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from rack.backplane.message import State
from rack.boards.config import RackConfig
from rack.levels.messages import SCENE, TASK_STATUS
from rack.tools.recording.recording import Recording

Report = dict[str, Any]
DRIVING = ("servo_status", "arm_status")
HAND_STATUS = "hand_status"
WRENCH = "wrench"
FORCE_STATUS = "force_status"
"""Messages by name, as recordings hold them: to report on them takes no level that only other racks
have."""
FALLING_M_S = 0.05
"""Speed from which an object falls: a grip that slips, or fingers that lower it, are slower."""
BOUNCE = 2
"""Samples between the parts of one fall."""
SETTLE = 20
"""Samples after a fall in which the object comes to rest: at first it sinks into what it landed on,
or bounces."""
LEAST_M = 0.005
"""Least fall reported: tasks let go up to 2 mm above the support, and pads that open take a part
along."""


def task_outcome(recording: Recording) -> Report | None:
    """Return the last status of the level that reports on the whole task."""
    mailbox = _mailbox_of(recording, TASK_STATUS.name)
    if mailbox is None:
        return None

    def last(field: str) -> Any:
        return recording.signal(mailbox, field)[-1]

    counts = {
        name: int(last(name)) for name in ("action", "actions", "moves_done", "moves", "error")
    }
    return {
        "state": State(int(last("state"))).name.lower(),
        "reason": recording.reason(mailbox, -1),
        **counts,
    }


def objects(recording: Recording, config: RackConfig) -> Iterator[Report]:
    """Yield where each object that has a goal ended, and its falls."""
    for end in recording.ended.get("outcome", {}).get("objects", ()):
        row = config.scene.objects.index(end["object"])
        yield {**end, "drops": list(_drops(recording, row))}


def _drops(recording: Recording, row: int) -> Iterator[Report]:
    """Yield tick and height, mm, of each fall of an object: it goes down quickly, and not with the
    tool."""
    mailbox = _mailbox_of(recording, SCENE.name)
    if mailbox is None:
        return
    ticks = recording.signal(mailbox, "tick")
    place = recording.signal(mailbox, "position")[:, row]
    # What moves and turns with the tool keeps its distance from it.
    away = np.linalg.norm(place - recording.signal(mailbox, "tool_position"), axis=1)
    height = place[:, 2]
    least = FALLING_M_S * recording.layout.clock_ns * 1e-9 * np.diff(ticks)
    falling = np.flatnonzero(np.minimum(-np.diff(height), np.abs(np.diff(away))) > least)
    first = falling[np.diff(falling, prepend=-BOUNCE - 1) > BOUNCE]
    last = falling[np.diff(falling, append=len(ticks) + BOUNCE) > BOUNCE] + 1
    for begin, end in zip(first, last, strict=True):
        if (fallen := height[begin] - height[end:][:SETTLE][-1]) > LEAST_M:
            yield {"tick": int(ticks[begin]), "mm": rounded(fallen * 1e3)}


def motion(recording: Recording) -> Report | None:
    """Return tracking error, mrad, and the counts of touches, exceeded limits and clipped set
    points, or None."""
    mailbox = _mailbox_of(recording, *DRIVING)
    if mailbox is None:
        return None
    error = (recording.signal(mailbox, "position") - recording.signal(mailbox, "target")) * 1e3
    return {
        "tracking_rms_mrad": _rms(error),
        "tracking_peak_mrad": rounded(np.abs(error).max()),
        **_counts(recording, mailbox),
    }


def _counts(recording: Recording, mailbox: str) -> Report:
    """Return what a board that drives an arm or a hand has counted."""
    names = {name: name for name in ("touches", "violations", "pushed")} | {
        "clipped_cycles": "clipped"
    }
    return {key: int(recording.signal(mailbox, name)[-1]) for key, name in names.items()}


def _rms(error: np.ndarray) -> float:
    return rounded(np.sqrt(np.mean(error**2)))


def rounded(value: float) -> float:
    """Return a number as reports show it."""
    return round(float(value), 6)


def hand(recording: Recording, config: RackConfig) -> Report | None:
    """Return a hand's tensions as far as commanded, N, its forces by finger, N, and its counts, or
    None."""
    mailbox = _mailbox_of(recording, HAND_STATUS)
    if mailbox is None or config.robot is None or config.robot.hand is None:
        return None
    tension = recording.signal(mailbox, "tension")
    forces = recording.signal(mailbox, "force")
    error = tension - recording.signal(mailbox, "wanted")
    most = np.linalg.norm(forces, axis=2).max(axis=0)
    fingers = [finger.name for finger in config.robot.hand.finger]
    return {
        "tension_rms_n": _rms(error),
        "tension_peak_n": rounded(np.abs(error).max()),
        "least_tension_n": rounded(tension.min()),
        "largest_tension_n": rounded(tension.max()),
        "largest_force_n": {
            finger: rounded(value) for finger, value in zip(fingers, most, strict=True)
        },
        "closed_cycles": int(np.count_nonzero(recording.signal(mailbox, "stopped"))),
        **_counts(recording, mailbox),
    }


def force(recording: Recording) -> Report | None:
    """Return what an arm's wrist has felt, N and N m, and how far forces were from those wanted, N,
    or None."""
    wrench = _mailbox_of(recording, WRENCH)
    status = _mailbox_of(recording, FORCE_STATUS)
    if wrench is None:
        return None
    halves = recording.signal(wrench, "wrench").reshape(-1, 2, 3)
    most_n, most_nm = np.linalg.norm(halves, axis=2).max(axis=0)
    error = np.zeros(0)
    if status is not None:
        # The tool exerts the opposite of what it feels.
        off = recording.signal(status, "wanted") + recording.signal(status, "wrench")
        error = off[:, :3][recording.signal(status, "selected")[:, :3] == 1]
    return {
        "largest_force_n": rounded(most_n),
        "largest_torque_nm": rounded(most_nm),
        "exceeded_cycles": int(recording.signal(wrench, "exceeded")[-1]),
        "force_rms_n": _rms(error) if len(error) else None,
    }


def _mailbox_of(recording: Recording, *messages: str) -> str | None:
    """Return the first mailbox with messages of one of these types; None when it is empty, or there
    is none."""
    name = next((m.name for m in recording.layout.mailboxes if m.message in messages), None)
    return name if name in recording.mailboxes else None
