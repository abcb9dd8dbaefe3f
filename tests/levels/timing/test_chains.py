"""Names of boards in parallel chains."""

from __future__ import annotations

import pytest

from rack.levels.timing.chains import spanned


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (("joint1", "joint2", "joint3"), "joint1 ... joint3"),
        (("joint9", "joint10", "joint11"), "joint9 ... joint11"),
        (("j1.planner", "j2.planner", "j3.planner"), "j1.planner ... j3.planner"),
        (("joint1", "joint2"), "joint1, joint2"),
        (("joint1", "joint2", "joint4"), "joint1, joint2, joint4"),
        (("joint2", "joint1", "joint3"), "joint2, joint1, joint3"),
        (("a1", "b2", "c3"), "a1, b2, c3"),
        (("joint1", "joint2", "joint3", "arm"), "joint1 ... joint3, arm"),
        (("servo",), "servo"),
        ((), ""),
    ],
)
def test_numbered_names_are_shortened_only_if_none_is_left_out(
    names: tuple[str, ...], text: str
) -> None:
    assert spanned(names) == text
