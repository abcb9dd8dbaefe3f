"""Pictures of a hand: well-formed SVG in which everything is where it is, to the pixel."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from rack.levels.systems.hand.picture import (
    NEWTONS_A_VIEW,
    REACH_M,
    SIDE,
    HandPicture,
    HandScene,
    hull,
)
from tests.levels.arms import cell

HAND = cell("utah_mit")
START = HAND.start()
SVG = "{http://www.w3.org/2000/svg}"


def scene(force: np.ndarray, contact: np.ndarray | None = None) -> HandScene:
    return HandScene(
        position=HAND.home,
        bodies=START.xpos[HAND.bodies],
        quaternions=START.xquat[HAND.bodies],
        force=force,
        contact=np.empty((0, 3)) if contact is None else contact,
        held=0,
    )


def drawn(*args: object, **kwargs: object) -> list[ElementTree.Element]:
    """Return the views of a picture, from the front and from above."""
    root = ElementTree.fromstring(HandPicture(HAND).draw(*args, **kwargs))  # type: ignore[arg-type]
    return root.findall(f"{SVG}svg")


def test_every_finger_is_a_line_through_its_joints_to_its_tip_and_has_its_name() -> None:
    front, above = drawn(scene(np.zeros((4, 3))))
    for view in (front, above):
        lines = view.findall(f"{SVG}polyline")
        assert [len(line.attrib["points"].split()) for line in lines] == [5, 5, 5, 5]
        assert [text.text for text in view.findall(f"{SVG}text")][:-1] == [
            "index",
            "middle",
            "ring",
            "thumb",
        ]
    ends = [
        line.attrib["points"].split()[-1].split(",") for line in front.findall(f"{SVG}polyline")
    ]
    heights = [float(y) for _, y in ends]
    # Index, middle and ring are above each other, 3 cm apart.
    assert np.diff(heights[:3]) == pytest.approx(np.full(2, 0.03 / REACH_M * SIDE / 2), abs=0.2)


def test_a_force_is_an_arrow_in_the_worlds_frame_as_long_as_it_is_large() -> None:
    # Along the fingers, x of the palm and of the world.
    front, above = drawn(scene(np.array([[8.0, 0.0, 0.0], *np.zeros((3, 3))])))
    for view in (front, above):
        (line,) = view.findall(f"{SVG}line")
        x1, y1, x2, y2 = (float(line.attrib[key]) for key in ("x1", "y1", "x2", "y2"))
        assert x2 - x1 == pytest.approx(8.0 / NEWTONS_A_VIEW * SIDE / 2, abs=0.2)
        assert y2 == pytest.approx(y1, abs=0.2)
    assert not drawn(scene(np.full((4, 3), 1e-3)))[0].findall(f"{SVG}line")


def test_contacts_of_a_plan_are_shown_on_the_object() -> None:
    *_, above = drawn(scene(np.zeros((4, 3)), np.array([[0.024, 0.0, 0.0], [-0.024, 0.0, 0.0]])))
    rings = [circle for circle in above.findall(f"{SVG}circle") if circle.attrib["fill"] == "none"]
    left, right = sorted(float(ring.attrib["cx"]) for ring in rings)
    assert right - left == pytest.approx(0.048 / REACH_M * SIDE / 2, abs=0.2)


def test_text_is_escaped() -> None:
    text = HandPicture(HAND).draw(scene(np.zeros((4, 3))), ["force < 3 N & more"])
    assert "force &lt; 3 N &amp; more" in text


def test_a_hull_is_that_of_its_outermost_points_in_order() -> None:
    square = [(0.0, 0.0), (0.0, 2.0), (2.0, 0.0), (2.0, 2.0), (1.0, 1.0), (1.0, 0.0)]
    assert sorted(hull(square)) == [(0.0, 0.0), (0.0, 2.0), (2.0, 0.0), (2.0, 2.0)]
    assert hull([(0.0, 0.0), (1.0, 1.0)]) == [(0.0, 0.0), (1.0, 1.0)]
