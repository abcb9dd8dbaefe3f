"""The colours of the view, one meaning each; red, green, blue, alpha."""

from __future__ import annotations

Colour = tuple[int, int, int, int]

_JOINTS: tuple[Colour, ...] = (
    (86, 180, 233, 255),
    (230, 159, 0, 255),
    (0, 190, 140, 255),
    (240, 228, 66, 255),
    (204, 121, 167, 255),
    (213, 94, 0, 255),
    (150, 140, 255, 255),
)
"""Told apart also by who sees no red or no green (Okabe and Ito)."""
COMMANDED: Colour = (130, 130, 130, 160)
LIMIT: Colour = (200, 60, 60, 110)
PLANNED: Colour = (255, 200, 40, 255)
GOAL: Colour = (70, 210, 90, 255)
CURRENT: Colour = (255, 110, 40, 255)

STATES: dict[str, Colour] = {
    "idle": (110, 110, 120, 255),
    "executing": (70, 140, 230, 255),
    "done": (70, 180, 90, 255),
    "holding": (230, 180, 60, 255),
    "error": (220, 50, 50, 255),
    "missed": (240, 140, 30, 255),
    "lost": (120, 20, 20, 255),
}
EVENTS: dict[str, Colour] = {
    "launch": (110, 110, 120, 255),
    "ready": (110, 110, 120, 255),
    "start": (70, 140, 230, 255),
    "stop": (240, 140, 30, 255),
    "end": (70, 180, 90, 255),
    "died": (220, 50, 50, 255),
    "fault": (190, 90, 210, 255),
    "detection": (240, 140, 30, 255),
    "reaction": (220, 90, 60, 255),
    "recovery": (70, 180, 90, 255),
}
"""Of a kind that is not here the viewer picks a colour."""
PHASES: dict[str, Colour] = {
    "wait": (60, 62, 70, 255),
    "read": (90, 170, 220, 255),
    "process": (70, 180, 90, 255),
    "plan": (150, 110, 220, 255),
    "write": (230, 180, 60, 255),
    "missed": (230, 50, 50, 255),
}


def of_joint(at: int) -> Colour:
    """Return the colour of the joint at that place, from base to tool."""
    return _JOINTS[at % len(_JOINTS)]
