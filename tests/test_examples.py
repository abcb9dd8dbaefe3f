"""The examples in configs/examples run as their READMEs say, from a folder anywhere."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import RACK, own_can_channel

pytestmark = pytest.mark.thorough

EXAMPLES = Path(__file__).parent.parent / "configs" / "examples"
FOLDERS = sorted(path.name for path in EXAMPLES.iterdir() if path.is_dir())
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
RACK_NAME = re.compile(r"""^(\W*name ?= ?["'])([\w-]+)""", re.MULTILINE)
RECORDED = ("own-arm", "own-level")
"""Examples whose recording differs from that of every other rack: another arm, and messages of the
user's own."""
REAL_TIME = ("can-arm",)
"""Examples that run in real time alone."""
PROGRAMS = {"rack": RACK, "python": (sys.executable,)}


def commands(folder: Path) -> list[list[str]]:
    """Return the commands of an example's README as words."""
    lines = "".join(SHELL.findall((folder / "README.md").read_text())).splitlines()
    return [line.partition("#")[0].split() for line in lines]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.alone] * (name in REAL_TIME)) for name in FOLDERS],
)
def test_example_runs_as_its_readme_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_CHANNEL", own_can_channel())
    folder = Path(shutil.copytree(EXAMPLES / name, tmp_path / name))
    for path in (path for end in ("toml", "py", "ipynb") for path in folder.glob(f"*.{end}")):
        path.write_text(RACK_NAME.sub(rf"\1\2-{os.getpid()}", path.read_text(), count=1))
    found = commands(folder)
    assert found
    for program, *words in found:
        unrecorded = ["--no-record"] if words[0] == "run" and name not in RECORDED else []
        command = [*PROGRAMS[program], *words, *unrecorded]
        done = subprocess.run(
            command, cwd=folder, capture_output=True, text=True, timeout=100, check=False
        )
        assert done.returncode == 0, (
            f"{program} {' '.join(words)}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        )


def test_the_list_of_examples_is_complete() -> None:
    assert (
        sorted(set(re.findall(r"\]\(([\w-]+)\)", (EXAMPLES / "README.md").read_text()))) == FOLDERS
    )
