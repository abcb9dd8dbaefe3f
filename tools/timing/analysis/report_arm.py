"""What the task, its objects and the arm or hand did, as a report's text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

Report = dict[str, Any]


def task_text(task: Report | None) -> Iterator[str]:
    """Yield how far the task came; nothing without one."""
    if task is not None:
        done = (
            f"{task['action']} of {task['actions']} actions, {task['moves_done']} of"
            f" {task['moves']} elemental moves"
        )
        yield from (
            "",
            f"Task {task['state']}: {done}{'; ' + task['reason'] if task['reason'] else ''}.",
        )


def objects_text(objects: Sequence[Report]) -> Iterator[str]:
    """Yield how far each object ended from its goal, and its falls."""
    for entry in objects:
        off = f"{entry['off_mm']:.1f} mm from its goal (tolerance {entry['tolerance_mm']:g} mm)"
        yield f"Object {entry['object']} ended {off}."
        for drop in entry.get("drops", ()):
            yield (
                f"Object {entry['object']} was let go {drop['mm']:.0f} mm above what it landed on, "
                f"at tick {drop['tick']}."
            )


def motion_text(motion: Report | None) -> Iterator[str]:
    """Yield how the arm followed, what it touched, and whether it kept its limits."""
    if motion is not None:
        yield (
            f"Tracking error {motion['tracking_rms_mrad']:.3f} mrad RMS,"
            f" {motion['tracking_peak_mrad']:.3f} peak; {motion['touches']} touches,"
            f" {motion['clipped_cycles']} cycles clipped; limits exceeded in {motion['violations']}"
            f" substeps, by a push from outside in {motion['pushed']}."
        )


def hand_text(hand: Report | None) -> Iterator[str]:
    """Yield how tendons followed, and the largest force on each fingertip."""
    if hand is None:
        return
    yield (
        f"Tensions {hand['tension_rms_n']:.2f} N RMS off their commands,"
        f" {hand['tension_peak_n']:.2f} peak; {hand['least_tension_n']:.2f} to"
        f" {hand['largest_tension_n']:.2f} N; valves closed in {hand['closed_cycles']} cycles;"
        f" {hand['touches']} touches, {hand['clipped_cycles']} cycles clipped; limits exceeded in"
        f" {hand['violations']} substeps, by a push from outside in {hand['pushed']}."
    )
    forces = ", ".join(f"{finger} {force:.2f}" for finger, force in hand["largest_force_n"].items())
    yield f"Largest force on each tip, N: {forces}."


def force_text(force: Report | None) -> Iterator[str]:
    """Yield the largest force and torque of contacts, and how well axes of force followed."""
    if force is None:
        return
    off = (
        ""
        if force["force_rms_n"] is None
        else f"; axes of force {force['force_rms_n']:.2f} N RMS off"
    )
    yield (
        f"Contact: at most {force['largest_force_n']:.1f} N and {force['largest_torque_nm']:.2f} N"
        f" m, beyond the arm's limits in {force['exceeded_cycles']} cycles{off}."
    )
