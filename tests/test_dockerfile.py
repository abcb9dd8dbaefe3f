"""The Dockerfile sets up what the Makefile sets up, and runs the README's commands."""

from __future__ import annotations

import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()
MAKEFILE = (ROOT / "Makefile").read_text()
LINES = (ROOT / "Dockerfile").read_text().splitlines()
STEPS = [tuple(line.split(maxsplit=1)) for line in LINES if not line.startswith("#")]


def test_the_image_runs_the_first_commands_of_the_readme() -> None:
    assert len(LINES) <= 10
    block = re.search(r"```sh\n(.*?)```", README, re.DOTALL)
    assert block
    shown = re.findall(r"^(make \w+)", block[1], re.MULTILINE)
    (default,) = [" ".join(json.loads(words)) for step, words in STEPS if step == "CMD"]
    named = re.findall(r"^# docker run .* rack (make \w+)$", "\n".join(LINES), re.MULTILINE)
    assert [default, *named] == shown


def test_the_image_is_built_by_the_set_up_of_the_makefile() -> None:
    (set_up,) = [words for step, words in STEPS if step == "RUN" and words.startswith("make ")]
    variables = dict(re.findall(r"^(\w+) := (\S+)$", MAKEFILE, re.MULTILINE))
    assert set_up == "make " + variables["STAMP"].replace("$(VENV)", variables["VENV"])
    for target in ("run", "test"):
        assert re.search(rf"^{target}: \$\(STAMP\) ", MAKEFILE, re.MULTILINE)


def test_the_python_of_the_image_is_one_that_the_readme_permits() -> None:
    (image,) = [words for step, words in STEPS if step == "FROM"]
    version = re.fullmatch(r"python:3\.(\d+)-slim", image)
    permitted = re.search(r"Python 3\.(\d+) to 3\.(\d+)", README)
    assert version
    assert permitted
    assert int(permitted[1]) <= int(version[1]) <= int(permitted[2])
