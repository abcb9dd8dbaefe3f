"""`rack run --faults`: scripts by name and by path, and what they refuse."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.segment import list_racks
from rack.boards.config import load_text
from tests.tools.command_line import rack, read_answer, read_refusal

pytestmark = pytest.mark.slow

HANG = '[[fault]]\nkind = "hang"\nboard = "upper"\nat = 0.5\n'


@pytest.mark.thorough
def test_a_run_with_a_script_repeats_with_its_faults(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    script, run = tmp_path / "hang.toml", tmp_path / "run"
    script.write_text(HANG)
    words = ("--set", f"name={rack_name}", "--seconds", "2")
    report = read_answer("run", small, *words, "--faults", script, "--out", run)
    # The resolved config holds the script: it needs no file to run again.
    repeated = read_answer("run", run / "config.toml", *words, "--no-record")
    assert report["digest"] == repeated["digest"]
    assert [fault["struck"] for fault in report["faults"]] == [200]
    found = load_text((run / "config.toml").read_text())
    assert [(fault.kind, fault.at) for fault in found.fault] == [("hang", 0.5)]


SCRIPTS = {
    "noisy": "--faults = \"noisy\": no such file; did you mean 'noisy-bus'?",
    "[[fault]]\nkind = 'kill'": "fault[0].board: missing; affected task",
    "[[fault]]\nkind = 'kill'\nboard = 'servo'": (
        'fault[0].board = "servo": no such task; tasks: upper, lower'
    ),
    "[[fault]]\nkind = 'clock-stop'\nboard = 'clock'": (
        'fault[0].kind = "clock-stop": clock-stop needs real time'
    ),
    "[[fault]\n": "script.toml: not TOML: ",
    "[run]\n": "script.toml: run: a fault script contains [[fault]] tables and nothing else",
}


@pytest.mark.parametrize(("script", "line"), SCRIPTS.items())
def test_a_script_that_does_not_fit_is_refused_before_anything_starts(
    small: Path, rack_name: str, tmp_path: Path, script: str, line: str
) -> None:
    given = script
    if "\n" in script or " " in script:
        given = str(tmp_path / "script.toml")
        Path(given).write_text(script)
    words = ("--set", f"name={rack_name}", "--faults", given, "--out", tmp_path / "run")
    assert read_refusal(rack("run", small, *words)).startswith(line)
    assert not (tmp_path / "run").exists()
    assert rack_name not in list_racks()
