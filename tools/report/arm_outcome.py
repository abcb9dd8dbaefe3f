"""What the task, its objects and the arm or hand did, from a recording: as a report's data, and as
its text.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from rack.backplane.message import printable, state_name
from rack.boards.config import RackConfig
from rack.levels.messages import ArmState, Scene, TaskStatus
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Recording
from rack.tools.report.run_report import RunReport

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


Signals = Callable[[str], np.ndarray]
"""Returns a field of all messages of a mailbox, by its name."""


def task_outcome(recording: Recording) -> Document | None:
    """Return the last status of the level that reports on the whole task."""
    status = signals_of(recording, TaskStatus.message_type.name)
    if status is None:
        return None
    counts = ("action", "actions", "moves_done", "moves", "error")
    return {
        "state": state_name(int(status("state")[-1])),
        "reason": printable(str(status("reason")[-1])),
        **{name: int(status(name)[-1]) for name in counts},
    }


def objects(recording: Recording, config: RackConfig) -> Iterator[Document]:
    """Yield where each object that has a goal ended, and its falls."""
    for end in recording.ended.get("outcome", {}).get("objects", ()):
        row = config.scene.objects.index(end["object"])
        yield {**end, "drops": list(_drops(recording, row))}


def _drops(recording: Recording, row: int) -> Iterator[Document]:
    """Yield tick and height, mm, of each fall of an object: it goes down quickly, and not with the
    tool.
    """
    scene = signals_of(recording, Scene.message_type.name)
    if scene is None:
        return
    ticks = scene("tick")
    place = scene("position")[:, row]
    # What moves and turns with the tool keeps its distance from it.
    away = np.linalg.norm(place - scene("tool_position"), axis=1)
    height = place[:, 2]
    least = FALLING_M_S * recording.layout.clock_ns * 1e-9 * np.diff(ticks)
    falling = np.flatnonzero(np.minimum(-np.diff(height), np.abs(np.diff(away))) > least)
    first = falling[np.diff(falling, prepend=-BOUNCE - 1) > BOUNCE]
    last = falling[np.diff(falling, append=len(ticks) + BOUNCE) > BOUNCE] + 1
    for begin, end in zip(first, last, strict=True):
        if (fallen := height[begin] - height[end:][:SETTLE][-1]) > LEAST_M:
            yield {"tick": int(ticks[begin]), "mm": rounded(fallen * 1e3)}


def motion(recording: Recording) -> Document | None:
    """Return tracking error, mrad, where a status tells it, and the counts of touches, exceeded
    limits and refused or cut commands, or None.
    """
    status = signals_of(recording, *DRIVING)
    counts = _counts(recording, status)
    if not counts or signals_of(recording, HAND_STATUS) is not None:
        return None
    tracking: Document = dict.fromkeys(("tracking_rms_mrad", "tracking_peak_mrad"))
    if status is not None:
        error = (status("position") - status("target")) * 1e3
        tracking = dict(zip(tracking, _rms_and_peak(error), strict=True))
    return tracking | counts


def _counts(recording: Recording, status: Signals | None) -> Document:
    """Return what an arm or a hand has counted, by its state, and what the board that drives it has
    cut besides, by its status; nothing without either.
    """
    state = signals_of(recording, ArmState.message_type.name)
    if not (known := [found for found in (status, state) if found is not None]):
        return {}
    fields = {
        "touches": "touches",
        "violations": "violations",
        "pushed": "pushed",
        "clipped_cycles": "clipped",
    }
    return {key: max(int(found(name)[-1]) for found in known) for key, name in fields.items()}


def _rms_and_peak(error: np.ndarray) -> tuple[float, float]:
    return rounded(np.sqrt(np.mean(error**2))), rounded(np.abs(error).max())


def rounded(value: float) -> float:
    """Return a number as reports show it."""
    return round(float(value), 6)


def hand(recording: Recording, config: RackConfig) -> Document | None:
    """Return a hand's tensions as far as commanded, N, its forces by finger, N, and its counts, or
    None.
    """
    status = signals_of(recording, HAND_STATUS)
    if status is None or config.robot is None or config.robot.hand is None:
        return None
    tension = status("tension")
    rms_n, peak_n = _rms_and_peak(tension - status("wanted"))
    most = np.linalg.norm(status("force"), axis=2).max(axis=0)
    fingers = [finger.name for finger in config.robot.hand.finger]
    return {
        "tension_rms_n": rms_n,
        "tension_peak_n": peak_n,
        "least_tension_n": rounded(tension.min()),
        "largest_tension_n": rounded(tension.max()),
        "largest_force_n": dict(zip(fingers, map(rounded, most), strict=True)),
        "closed_cycles": int(np.count_nonzero(status("stopped"))),
        **_counts(recording, status),
    }


def force(recording: Recording) -> Document | None:
    """Return what an arm's wrist has felt, N and N m, and how far forces were from those wanted, N,
    or None.
    """
    wrench = signals_of(recording, WRENCH)
    status = signals_of(recording, FORCE_STATUS)
    if wrench is None:
        return None
    halves = wrench("wrench").reshape(-1, 2, 3)
    most_n, most_nm = np.linalg.norm(halves, axis=2).max(axis=0)
    error = np.zeros(0)
    if status is not None:
        # The tool exerts the opposite of what it feels.
        off = status("wanted") + status("wrench")
        error = off[:, :3][status("selected")[:, :3] == 1]
    return {
        "largest_force_n": rounded(most_n),
        "largest_torque_nm": rounded(most_nm),
        "exceeded_cycles": int(wrench("exceeded")[-1]),
        "force_rms_n": _rms_and_peak(error)[0] if len(error) else None,
    }


def signals_of(recording: Recording, *messages: str) -> Signals | None:
    """Return the signals of the first mailbox with messages of one of these types; None when it is
    empty, or there is none.
    """
    name = next((m.name for m in recording.layout.mailboxes if m.message in messages), None)
    return partial(recording.signal, name) if name in recording.mailboxes else None


def outcome_text(report: RunReport) -> Iterator[str]:
    """Yield how far the task came, where its objects ended, and what the arm or hand did."""
    if (task := report.task) is not None:
        done = (
            f"{task['action']} of {task['actions']} actions, {task['moves_done']} of"
            f" {task['moves']} elemental moves"
        )
        yield ""
        yield f"Task {task['state']}: {done}{'; ' + task['reason'] if task['reason'] else ''}."
    for end in report.objects:
        off = f"{end['off_mm']:.1f} mm from its goal (tolerance {end['tolerance_mm']:g} mm)"
        yield f"Object {end['object']} ended {off}."
        for drop in end.get("drops", ()):
            yield (
                f"Object {end['object']} was let go {drop['mm']:.0f} mm above what it landed on, "
                f"at tick {drop['tick']}."
            )
    if report.motion is not None:
        yield _motion_text(report.motion)
    if report.hand is not None:
        yield from _hand_text(report.hand)
    if report.force is not None:
        yield _force_text(report.force)


def _motion_text(motion: Document) -> str:
    tracking = ""
    if motion["tracking_rms_mrad"] is not None:
        tracking = (
            f"Tracking error {motion['tracking_rms_mrad']:.3f} mrad RMS,"
            f" {motion['tracking_peak_mrad']:.3f} peak; "
        )
    return f"{tracking}{_counts_text(motion)}"


def _counts_text(report: Document) -> str:
    return (
        f"{report['touches']} touches; commands refused or cut in {report['clipped_cycles']}"
        f" cycles; limits exceeded in {report['violations']} substeps, by a push from outside in"
        f" {report['pushed']}."
    )


def _hand_text(hand: Document) -> Iterator[str]:
    yield (
        f"Tensions {hand['tension_rms_n']:.2f} N RMS off their commands,"
        f" {hand['tension_peak_n']:.2f} peak; {hand['least_tension_n']:.2f} to"
        f" {hand['largest_tension_n']:.2f} N; valves closed in {hand['closed_cycles']} cycles;"
        f" {_counts_text(hand)}"
    )
    forces = ", ".join(f"{finger} {force:.2f}" for finger, force in hand["largest_force_n"].items())
    yield f"Largest force on each tip, N: {forces}."


def _force_text(force: Document) -> str:
    rms_n = force["force_rms_n"]
    off = "" if rms_n is None else f"; axes of force {rms_n:.2f} N RMS off"
    return (
        f"Contact: at most {force['largest_force_n']:.1f} N and {force['largest_torque_nm']:.2f} N"
        f" m, beyond the arm's limits in {force['exceeded_cycles']} cycles{off}."
    )
