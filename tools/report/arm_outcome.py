"""Outcome of the task, its objects, and the arm or hand, as data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from rack.backplane.message import escape_text, format_state
from rack.boards.config import RackConfig
from rack.levels.messages import ArmState, Scene, TaskStatus
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Recording

DRIVING = ("servo_status", "arm_status")
HAND_STATUS = "hand_status"
WRENCH = "wrench"
FORCE_STATUS = "force_status"
"""Names of message types.

The types are given by name, because a report must not import levels that only other racks have.
"""
FALLING_M_S = 0.05
"""Speed above which an object counts as falling. Slipping and lowered objects are slower."""
BOUNCE_SAMPLES = 2
"""Largest number of samples between two parts of the same fall."""
SETTLE_SAMPLES = 20
"""Number of samples after a fall until the object has come to rest.

Before that it may bounce, or sink into the surface on which it landed.
"""
MIN_FALL_M = 0.005
"""Smallest fall that is reported.

Tasks release objects up to 2 mm above the support, and opening pads can drag an object along.
"""
Signals = Callable[[str], np.ndarray]
"""Function from the name of a field to its values in all messages of a mailbox."""


def summarize_task(recording: Recording) -> Document | None:
    """Return the last `TaskStatus` of the run, or None if no level reports on the whole task."""
    status = find_signals(recording, TaskStatus.message_type.name)
    if status is None:
        return None
    counts = ("action", "actions", "moves_done", "moves", "error")
    return {
        "state": format_state(int(status("state")[-1])),
        "reason": escape_text(str(status("reason")[-1])),
        **{name: int(status(name)[-1]) for name in counts},
    }


def summarize_objects(recording: Recording, config: RackConfig) -> Iterator[Document]:
    """Yield an entry for each object with a goal: its distance from the goal, and its falls."""
    for end in recording.end_counts.get("outcome", {}).get("objects", ()):
        row = config.scene.objects.index(end["object"])
        yield {**end, "drops": list(_find_drops(recording, row))}


def _find_drops(recording: Recording, row: int) -> Iterator[Document]:
    """Yield tick and height (in mm) of each fall of an object.

    An object falls while it moves down quickly and its distance from the tool changes.

    Args:
        recording: The run.
        row: Index of the object in the messages of the scene.
    """
    scene = find_signals(recording, Scene.message_type.name)
    if scene is None:
        return
    ticks = scene("tick")
    position = scene("position")[:, row]
    # The distance from the tool does not change while the tool carries the object.
    distance = np.linalg.norm(position - scene("tool_position"), axis=1)
    height = position[:, 2]
    threshold_m = FALLING_M_S * recording.layout.clock_ns * 1e-9 * np.diff(ticks)
    falling = np.flatnonzero(np.minimum(-np.diff(height), np.abs(np.diff(distance))) > threshold_m)
    first = falling[np.diff(falling, prepend=-BOUNCE_SAMPLES - 1) > BOUNCE_SAMPLES]
    last = falling[np.diff(falling, append=len(ticks) + BOUNCE_SAMPLES) > BOUNCE_SAMPLES] + 1
    for begin, end in zip(first, last, strict=True):
        if (fallen := height[begin] - height[end:][:SETTLE_SAMPLES][-1]) > MIN_FALL_M:
            yield {"tick": int(ticks[begin]), "mm": round_figure(fallen * 1e3)}


def summarize_motion(recording: Recording) -> Document | None:
    """Return the RMS and peak tracking error and the event counts of an arm.

    Returns:
        The errors in mrad, which are None if no status contains them, and the numbers of touches,
        exceeded limits, and refused or clipped commands. The result is None without an arm.
    """
    status = find_signals(recording, *DRIVING)
    counts = _read_counts(recording, status)
    if not counts or find_signals(recording, HAND_STATUS) is not None:
        return None
    tracking: Document = dict.fromkeys(("tracking_rms_mrad", "tracking_peak_mrad"))
    if status is not None:
        error = (status("position") - status("target")) * 1e3
        tracking = dict(zip(tracking, _compute_rms_and_peak(error), strict=True))
    return tracking | counts


def _read_counts(recording: Recording, status: Signals | None) -> Document:
    """Return the final counts of touches, exceeded limits and clipped commands.

    These counts are in the state of the arm, and in the status of the board that drives the arm.
    The board also counts commands that it clipped itself, so the larger count is returned.

    Args:
        recording: The run.
        status: Status of the board that drives the arm or hand, or None.

    Returns:
        The counts, or {} without an arm or hand.
    """
    state = find_signals(recording, ArmState.message_type.name)
    if not (sources := [source for source in (status, state) if source is not None]):
        return {}
    fields = {
        "touches": "touches",
        "violations": "violations",
        "pushed": "pushed",
        "clipped_cycles": "clipped",
    }
    return {key: max(int(source(name)[-1]) for source in sources) for key, name in fields.items()}


def _compute_rms_and_peak(error: np.ndarray) -> tuple[float, float]:
    """Return the root mean square and the peak magnitude of an error."""
    return round_figure(np.sqrt(np.mean(error**2))), round_figure(np.abs(error).max())


def round_figure(value: float) -> float:
    """Round a number to the precision of reports, six decimal places."""
    return round(float(value), 6)


def summarize_hand(recording: Recording, config: RackConfig) -> Document | None:
    """Return tensions, tension errors and fingertip forces of a hand in N, and event counts.

    Returns:
        The results, or None without a hand.
    """
    status = find_signals(recording, HAND_STATUS)
    if status is None or config.robot is None or config.robot.hand is None:
        return None
    tension = status("tension")
    rms_n, peak_n = _compute_rms_and_peak(tension - status("wanted"))
    largest_forces = np.linalg.norm(status("force"), axis=2).max(axis=0)
    fingers = [finger.name for finger in config.robot.hand.finger]
    return {
        "tension_rms_n": rms_n,
        "tension_peak_n": peak_n,
        "least_tension_n": round_figure(tension.min()),
        "largest_tension_n": round_figure(tension.max()),
        "largest_force_n": dict(zip(fingers, map(round_figure, largest_forces), strict=True)),
        "closed_cycles": int(np.count_nonzero(status("stopped"))),
        **_read_counts(recording, status),
    }


def summarize_force(recording: Recording) -> Document | None:
    """Return the largest contact force and torque at the wrist, and the RMS force error.

    Returns:
        Forces in N and torques in N m. None without a wrist sensor.
    """
    wrench = find_signals(recording, WRENCH)
    status = find_signals(recording, FORCE_STATUS)
    if wrench is None:
        return None
    force_and_torque = wrench("wrench").reshape(-1, 2, 3)
    most_n, most_nm = np.linalg.norm(force_and_torque, axis=2).max(axis=0)
    error = np.zeros(0)
    if status is not None:
        # The sensed wrench is opposite to the wrench that the tool exerts, so their sum is the
        # error.
        surplus = status("wanted") + status("wrench")
        error = surplus[:, :3][status("selected")[:, :3] == 1]
    return {
        "largest_force_n": round_figure(most_n),
        "largest_torque_nm": round_figure(most_nm),
        "exceeded_cycles": int(wrench("exceeded")[-1]),
        "force_rms_n": _compute_rms_and_peak(error)[0] if len(error) else None,
    }


def find_signals(recording: Recording, *messages: str) -> Signals | None:
    """Return a function that reads the first mailbox with one of these message types.

    Returns:
        A function from the name of a field to its values in all messages. None if there is no such
        mailbox, or if none of its messages was recorded.
    """
    name = next((m.name for m in recording.layout.mailboxes if m.message in messages), None)
    return partial(recording.read_signal, name) if name in recording.mailboxes else None
