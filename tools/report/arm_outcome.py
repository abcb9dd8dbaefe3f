"""Outcome of the task, its objects, and the arm or hand, as data of a report and as its text."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from rack.backplane.message import escape_text, format_state
from rack.boards.config import RackConfig
from rack.levels.messages import ArmState, Scene, TaskStatus
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Recording
from rack.tools.report.run_report import RunReport

DRIVING = ("servo_status", "arm_status")
HAND_STATUS = "hand_status"
WRENCH = "wrench"
FORCE_STATUS = "force_status"
"""Message types by name, as recordings contain them.

A report must not import levels that only other racks have.
"""
FALLING_M_S = 0.05
"""Speed above which an object is falling. Slipping grips and lowering fingers are slower."""
BOUNCE_SAMPLES = 2
"""Number of samples that may separate two parts of the same fall."""
SETTLE_SAMPLES = 20
"""Number of samples after a fall until the object rests.

At first it sinks into the surface on which it landed, or bounces.
"""
MIN_FALL_M = 0.005
"""Smallest fall that is reported.

Tasks let go up to 2 mm above the support, and opening pads can take an object along.
"""


Signals = Callable[[str], np.ndarray]
"""Function that returns a field of all messages of a mailbox, by the field's name."""


def summarize_task(recording: Recording) -> Document | None:
    """Return the last status of the level that reports on the whole task, or None."""
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
    """Yield, for each object with a goal, its final position and its falls."""
    for end in recording.end_counts.get("outcome", {}).get("objects", ()):
        row = config.scene.objects.index(end["object"])
        yield {**end, "drops": list(_find_drops(recording, row))}


def _find_drops(recording: Recording, row: int) -> Iterator[Document]:
    """Yield the falls of an object: tick and height, mm.

    An object falls while it moves down quickly and its distance from the tool changes.
    """
    scene = find_signals(recording, Scene.message_type.name)
    if scene is None:
        return
    ticks = scene("tick")
    position = scene("position")[:, row]
    # An object that moves and turns with the tool keeps its distance from the tool.
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
    """Return the tracking error, mrad, and the counts of an arm, or None without an arm.

    The error is None if no status contains it. The counts are touches, exceeded limits, and refused
    or cut commands.
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
    """Return the final counts of an arm or hand, or {} without one.

    They come from the arm's state and from the status of the board that drives it, which counts
    commands that it cut itself. The larger count is returned.
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
    """Return the root mean square and the largest magnitude of an error."""
    return round_figure(np.sqrt(np.mean(error**2))), round_figure(np.abs(error).max())


def round_figure(value: float) -> float:
    """Round a number to the precision of reports."""
    return round(float(value), 6)


def summarize_hand(recording: Recording, config: RackConfig) -> Document | None:
    """Return the results of a hand, or None without one.

    They are tensions and their errors, N, the largest force of each finger, N, and counts.
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
    """Return the largest force, N, and torque, N m, at the wrist, and the force error, N.

    None without a wrist sensor.
    """
    wrench = find_signals(recording, WRENCH)
    status = find_signals(recording, FORCE_STATUS)
    if wrench is None:
        return None
    force_and_torque = wrench("wrench").reshape(-1, 2, 3)
    most_n, most_nm = np.linalg.norm(force_and_torque, axis=2).max(axis=0)
    error = np.zeros(0)
    if status is not None:
        # The tool exerts the opposite of the wrench that it feels.
        surplus = status("wanted") + status("wrench")
        error = surplus[:, :3][status("selected")[:, :3] == 1]
    return {
        "largest_force_n": round_figure(most_n),
        "largest_torque_nm": round_figure(most_nm),
        "exceeded_cycles": int(wrench("exceeded")[-1]),
        "force_rms_n": _compute_rms_and_peak(error)[0] if len(error) else None,
    }


def find_signals(recording: Recording, *messages: str) -> Signals | None:
    """Return the signals of the first mailbox that carries one of these message types.

    None if there is no such mailbox, or if it is empty.
    """
    name = next((m.name for m in recording.layout.mailboxes if m.message in messages), None)
    return partial(recording.read_signal, name) if name in recording.mailboxes else None


def format_outcome(report: RunReport) -> Iterator[str]:
    """Yield sentences about the task, the objects, and the arm or hand."""
    if (task := report.task) is not None:
        done = (
            f"{task['action']} of {task['actions']} actions, {task['moves_done']} of"
            f" {task['moves']} elemental moves"
        )
        yield ""
        yield f"Task {task['state']}: {done}{'; ' + task['reason'] if task['reason'] else ''}."
    for end in report.objects:
        distance = f"{end['off_mm']:.1f} mm from its goal (tolerance {end['tolerance_mm']:g} mm)"
        yield f"Object {end['object']} ended {distance}."
        for drop in end.get("drops", ()):
            yield f"Object {end['object']} fell {drop['mm']:.0f} mm at tick {drop['tick']}."
    if report.motion is not None:
        yield _format_motion(report.motion)
    if report.hand is not None:
        yield from _format_hand(report.hand)
    if report.force is not None:
        yield _format_force(report.force)


def _format_motion(motion: Document) -> str:
    """Return a sentence about the tracking error and the counts of an arm."""
    tracking = ""
    if motion["tracking_rms_mrad"] is not None:
        tracking = (
            f"Tracking error {motion['tracking_rms_mrad']:.3f} mrad RMS,"
            f" {motion['tracking_peak_mrad']:.3f} peak; "
        )
    return f"{tracking}{_format_counts(motion)}"


def _format_counts(report: Document) -> str:
    """Return a sentence about the counts of an arm or hand."""
    return (
        f"{report['touches']} touches; commands refused or cut in {report['clipped_cycles']}"
        f" cycles; limits exceeded in {report['violations']} substeps, of which an external push"
        f" caused {report['pushed']}."
    )


def _format_hand(hand: Document) -> Iterator[str]:
    """Yield sentences about the tensions and forces of a hand."""
    yield (
        f"Tension error {hand['tension_rms_n']:.2f} N RMS, {hand['tension_peak_n']:.2f} peak;"
        f" tensions from {hand['least_tension_n']:.2f} to {hand['largest_tension_n']:.2f} N;"
        f" valves closed in {hand['closed_cycles']} cycles;"
        f" {_format_counts(hand)}"
    )
    forces = ", ".join(f"{finger} {force:.2f}" for finger, force in hand["largest_force_n"].items())
    yield f"Largest force on each tip, N: {forces}."


def _format_force(force: Document) -> str:
    """Return a sentence about the contact forces of an arm."""
    rms_n = force["force_rms_n"]
    error = "" if rms_n is None else f"; force error {rms_n:.2f} N RMS"
    return (
        f"Contact: at most {force['largest_force_n']:.1f} N and {force['largest_torque_nm']:.2f} N"
        f" m, above the arm's limits in {force['exceeded_cycles']} cycles{error}."
    )
