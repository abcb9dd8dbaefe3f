"""Tests the tasks that `rack robot new` finds for an arm."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.levels.errors import Refused
from rack.tools.robot import assignment
from rack.tools.robot.draft import NOTHING, Wishes, draft
from rack.tools.robot.source import read_source
from tests.tools.robot.models import urdf, written


@pytest.mark.slow
def test_a_rehearsal_finds_no_more_paths_when_its_time_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = draft(read_source(written(tmp_path, urdf())), Wishes(), tmp_path, "drafted")
    home = [{"do": "home"}]
    assignment._rehearse(made, NOTHING, home)
    monkeypatch.setattr(assignment, "REHEARSAL_S", 0.0)
    with pytest.raises(Refused, match="no way found in 0 s of processor time"):
        assignment._rehearse(made, NOTHING, home)
