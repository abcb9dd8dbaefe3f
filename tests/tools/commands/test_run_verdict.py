"""Tests that exit status, first line, files and documents of a run have the same verdict."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rack.tools.launch.verdict import UNRECORDED
from rack.tools.report.summary import format_run_summary
from tests.tools.command_line import rack, read_answer

CRASHES = (
    "board.lower.executor=two_levels:Crashing",
    "supervision.max_missed_fraction=0.05",
    "supervision.lockstep_restart_s=0.1",
)
"""A level that dies in each of its first cycles; the run ends before its restarts do."""
LATE = "level 'lower' missed 0 and skipped 120 of its 120 cycles (100 %; at most 5 % permitted)"


@pytest.mark.thorough
def test_a_failed_run_has_the_same_verdict_everywhere(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    settings = [word for setting in (f"name={rack_name}", *CRASHES) for word in ("--set", setting)]
    words = ("run", small, "--seconds", 0.3, *settings)
    folder = tmp_path / "run"
    recorded = rack(*words, "--out", folder)
    line = f"{rack_name} failed: {LATE}"
    report = json.loads((folder / "report.json").read_text())
    text = (folder / "report.md").read_text()
    failed = f"{rack_name}: FAILED after 0.3 s (lockstep)"
    assert (recorded.returncode, recorded.stderr.splitlines()[-1]) == (1, line)
    assert text.splitlines()[0] == f"# {line}"
    assert recorded.stdout.startswith(failed)
    assert " ".join(recorded.stdout.split()).count(f"because {LATE}") == 1
    assert (report["worked"], report["failures"]) == (False, [LATE])
    # All are in the list of missed and skipped cycles, those after the last restart too.
    found = [miss for miss in report["misses"] if miss["task"] == "lower"]
    assert sum(miss["count"] for miss in found) == report["tasks"]["lower"]["skipped"] == 120
    (folder / "report.json").unlink()
    again = read_answer("report", folder)
    assert (again["worked"], again["failures"]) == (False, [LATE])

    bare = rack(*words, "--no-record", "--json")
    assert (bare.returncode, bare.stderr.splitlines()[-1]) == (1, line)
    document = json.loads(bare.stdout)
    summary = format_run_summary(document)
    assert summary[0] == failed
    assert f"unjudged  {UNRECORDED}" in summary
    assert (document["worked"], document["failures"]) == (False, [LATE])
    assert document["unjudged"] == [UNRECORDED]
    assert document["tasks"]["lower"]["skipped"] == 120
