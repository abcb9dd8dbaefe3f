"""The examples in configs/examples run as their READMEs say, from a folder anywhere."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from tests.processes import RACK, own_can_channel, run_to_end

pytestmark = pytest.mark.thorough

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "configs" / "examples"
FOLDERS = sorted(path.name for path in EXAMPLES.iterdir() if path.is_dir())
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
RACK_NAME = re.compile(r"""^(\W*name ?= ?["'])([\w-]+)""", re.MULTILINE)
RECORDED = ("own-arm", "own-level")
"""Examples whose recording differs from that of every other rack: another arm, and messages of the
user's own."""
REAL_TIME = ("can-arm",)
"""Examples that run in real time alone."""
LEAST_IN_TIME = 0.95
"""Part of the samples that must come in time without a rack, for one to be judged."""
BOUND_S = 100.0
REAL_TIME_BOUND_S = 250.0
"""Longest time of a command: an arm that waits for late samples has taken twice its time."""
ALONE = [pytest.mark.alone, pytest.mark.timeout(REAL_TIME_BOUND_S + 50.0)]
PROGRAMS = {"rack": RACK, "python": (sys.executable,)}


def commands(folder: Path) -> list[list[str]]:
    """Return the commands of an example's README as words."""
    lines = "".join(SHELL.findall((folder / "README.md").read_text())).splitlines()
    return [line.partition("#")[0].split() for line in lines]


def part_in_time() -> float:
    """Return the part of the exchanges with the drives of `can-arm` that come in time here, without
    a rack: where the page's figures are from, 98 % do."""
    command = [sys.executable, "-m", "tests.can_cost", "--json"]
    done = run_to_end(command, 60, cwd=ROOT, check=True)
    return float(json.loads(done.stdout)["in_time"])


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=ALONE if name in REAL_TIME else []) for name in FOLDERS],
)
def test_example_runs_as_its_readme_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_CHANNEL", own_can_channel())
    if name in REAL_TIME and (part := part_in_time()) < LEAST_IN_TIME:
        pytest.skip(f"six drives at 500 Hz need a faster machine: {part:.0%} of samples in time")
    folder = Path(shutil.copytree(EXAMPLES / name, tmp_path / name))
    for path in (path for end in ("toml", "py", "ipynb") for path in folder.glob(f"*.{end}")):
        path.write_text(RACK_NAME.sub(rf"\1\2-{os.getpid()}", path.read_text(), count=1))
    found = commands(folder)
    assert found
    bound_s = REAL_TIME_BOUND_S if name in REAL_TIME else BOUND_S
    for program, *words in found:
        unrecorded = ["--no-record"] if words[0] == "run" and name not in RECORDED else []
        if words[0] == "run":
            # The machine may be too busy to be in time.
            unrecorded += ["--set", "supervision.max_missed_fraction=1"]
        command = [*PROGRAMS[program], *words, *unrecorded]
        done = run_to_end(command, bound_s, cwd=folder)
        assert done.returncode == 0, (
            f"{program} {' '.join(words)}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        )


def test_the_list_of_examples_is_complete() -> None:
    assert (
        sorted(set(re.findall(r"\]\(([\w-]+)\)", (EXAMPLES / "README.md").read_text()))) == FOLDERS
    )
