"""Tests `rack robot check`: problems of an arm are found before it moves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.tools.command_line import ROOT, rack, read_answer, read_refusal
from tests.tools.robot.models import written

EXAMPLE = ROOT / "configs" / "examples" / "own-arm" / "desk-arm.toml"
pytestmark = pytest.mark.slow


def checked(folder: Path, given: object, status: int) -> Any:
    words = ("robot", "check", given, "--out", folder / "arm.png")
    return read_answer(*words, status=status, folder=folder)


def failing(found: dict[str, Any]) -> dict[str, str]:
    return {one["about"]: one["text"] for one in found["findings"] if one["fails"]}


def test_a_good_arm_passes_with_its_axes_and_abilities(tmp_path: Path) -> None:
    found = checked(tmp_path, EXAMPLE, 0)
    assert [row["axis"] for row in found["joints"]][:2] == [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]
    assert found["reach_m"] == pytest.approx(0.97, abs=0.01)
    assert not failing(found)
    is_drawn = (tmp_path / "arm.png").exists()
    assert is_drawn or "OpenGL" in found["picture"]


def test_contacts_at_home_unattached_bodies_and_endless_falls_fail(tmp_path: Path) -> None:
    model = EXAMPLE.with_name("desk-arm.xml").read_text()
    loose = '<body name="flap" pos="0 2 1"><joint axis="0 1 0"/><geom size=".05"/></body>'
    cup = '<body name="cup" pos="5 5 1"><freejoint/><geom size=".02"/></body>'
    written(tmp_path, model.replace("</worldbody>", f"{loose}{cup}</worldbody>"), "desk-arm.xml")
    text = EXAMPLE.read_text().replace("objects = []", 'objects = ["cup"]')
    text = text.replace("1.8, 0.0, 1.9416, 0.0]", "2.5, 0.0, 1.9416, 0.0]")
    text = text.replace("home = [0.0, -0.6", "home = [0.0, 1.2")
    found = failing(checked(tmp_path, written(tmp_path, text, "own.toml"), 1))
    assert "desk" in found["contacts at home"] or "world" in found["contacts at home"]
    assert found["unattached bodies"] == "flap"
    assert found["objects"] == "'cup' falls without end"


@pytest.mark.parametrize("name", ["a.xml", "a.sdf"])
def test_a_file_that_is_not_a_model_is_refused(name: str, tmp_path: Path) -> None:
    model = written(tmp_path, "<sdf/>", name)
    refusal = read_refusal(rack("robot", "check", model, folder=tmp_path))
    assert refusal.endswith("<sdf>; valid: <mujoco> (MJCF), <robot> (URDF)")
