"""`rack run --faults`: scripts by name and by path, and what they refuse."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from rack.backplane.segment import list_racks
from rack.boards.config import load_text
from tests.tools.command_line import rack, read_refusal

pytestmark = pytest.mark.slow

HANG = '[[fault]]\nkind = "hang"\nboard = "upper"\nat = 0.5\n'


def run(config: Path | str, name: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return rack("run", config, "--set", f"name={name}", *arguments)


@pytest.mark.thorough
def test_a_run_with_a_script_repeats_with_its_faults(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    script = tmp_path / "hang.toml"
    script.write_text(HANG)
    words = ("--seconds", "2", "--json")
    done = run(small, rack_name, "--faults", script, "--out", tmp_path / "run", *words)
    assert done.returncode == 0, done.stderr
    # The resolved config holds the script: it needs no file to run again.
    again = run(tmp_path / "run" / "config.toml", rack_name, "--no-record", *words)
    assert again.returncode == 0, again.stderr
    report, repeated = json.loads(done.stdout), json.loads(again.stdout)
    assert report["digest"] == repeated["digest"]
    assert [fault["struck"] for fault in report["faults"]] == [200]
    found = load_text((tmp_path / "run" / "config.toml").read_text())
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
    done = run(small, rack_name, "--faults", given, "--out", tmp_path / "run")
    assert read_refusal(done).startswith(line)
    assert not (tmp_path / "run").exists()
    assert rack_name not in list_racks()
