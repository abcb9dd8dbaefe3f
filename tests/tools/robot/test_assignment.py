"""Tests the tasks that `rack robot new` finds for an arm."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.levels.errors import Refused
from rack.tools.robot import assignment
from rack.tools.robot.draft import EMPTY_SCENE, ArmOptions, draft_arm
from rack.tools.robot.source import read_source
from tests.tools.robot.models import urdf, written


@pytest.mark.slow
def test_a_rehearsal_finds_no_more_paths_when_its_time_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = draft_arm(read_source(written(tmp_path, urdf())), ArmOptions(), tmp_path, "drafted")
    home = [{"do": "home"}]
    assignment._rehearse_program(made, EMPTY_SCENE, home)
    monkeypatch.setattr(assignment, "REHEARSAL_S", 0.0)
    with pytest.raises(Refused, match="no way found in 0 s of processor time"):
        assignment._rehearse_program(made, EMPTY_SCENE, home)
