"""The exercises in configs/course run as their pages say, with the figures that stand there, and so
do the answers."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.processes import run_to_end
from tests.test_examples import PROGRAMS, RACK_NAME
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough

COURSE = Path(__file__).parent.parent / "configs" / "course"
EXERCISES = sorted(path.name for path in COURSE.iterdir() if path.is_dir())
ANSWERS = re.split(r"^## ", (COURSE / "answers.md").read_text(), flags=re.MULTILINE)[1:]
STEP = re.compile(r"```sh\n(.*?)```\n(?:\n```\n(.*?)```)?", re.DOTALL)
"""Commands, and lines that they print: "..." stands for anything, N for one number above 0."""
MOST_LINES = 60
BOUND_S = 150.0
"""Longest time of a command of Python."""


@pytest.fixture(autouse=True)
def as_in_a_new_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Other tests of this process have imported the course's modules, which racks launched from it
    would then find before those of a copy."""
    path = [folder for folder in sys.path if COURSE not in Path(folder).parents]
    monkeypatch.setattr(sys, "path", path)
    forget_modules()
    yield
    forget_modules()


def forget_modules() -> None:
    """Let modules of these names be imported anew."""
    for module in COURSE.rglob("*.py"):
        sys.modules.pop(module.stem, None)


def is_shown(line: str, printed: str) -> bool:
    """Return whether a line of a page is in the output."""
    pattern = ".*".join(map(re.escape, line.split("...")))
    pattern = re.sub(r"\bN\b", r"([1-9]\\d*)", pattern, count=1)
    return re.search(re.sub(r"\bN\b", r"\\1\\b", pattern), printed) is not None


def run(line: str, folder: Path) -> tuple[int, str]:
    """Run a command of a page; return its exit status and what it printed."""
    program, *words = shlex.split(line)
    if program == "rack":
        done = rack(*words, folder=folder)
    else:
        done = run_to_end([*PROGRAMS.get(program, (program,)), *words], BOUND_S, cwd=folder)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.timeout(3 * BOUND_S)
@pytest.mark.parametrize("number", range(len(EXERCISES)), ids=EXERCISES)
def test_exercise_and_its_answer_show_what_their_pages_say(number: int, tmp_path: Path) -> None:
    name = EXERCISES[number]
    folder = Path(shutil.copytree(COURSE / name, tmp_path / name))
    own = f"-in-test-{os.getpid()}"
    for path in folder.glob("*.toml"):
        path.write_text(RACK_NAME.sub(rf"\1\2{own}", path.read_text(), count=1))
    for text in ((folder / "README.md").read_text(), ANSWERS[number]):
        steps = STEP.findall(text)
        assert steps
        for commands, shown in steps:
            printed = ""
            for line in commands.splitlines():
                command, _, remark = line.partition("#")
                if line.startswith("rack run") and not remark:
                    # The machine may be too busy to be in time.
                    command += " --set supervision.max_missed_fraction=1"
                status, answer = run(command, folder)
                printed += answer.replace(own, "")
                assert status == ("exit status 1" in remark), f"{line}: {printed[-3000:]}"
            missing = [line for line in shown.splitlines() if not is_shown(line, printed)]
            assert not missing, f"{missing} after {commands}: {printed}"


def test_the_course_lists_its_exercises_and_answers_each() -> None:
    listed = re.findall(
        r"^\| \[.*?\]\(([\w-]+)\)", (COURSE / "README.md").read_text(), re.MULTILINE
    )
    assert listed == EXERCISES
    titles = [(COURSE / name / "README.md").read_text().splitlines()[0] for name in EXERCISES]
    assert [f"# {answer.splitlines()[0]}" for answer in ANSWERS] == titles
    assert all(
        len((COURSE / name / "README.md").read_text().splitlines()) <= MOST_LINES
        for name in EXERCISES
    )


def test_the_table_of_rates_has_the_errors_that_the_commands_print() -> None:
    """Its other column, the load, has two decimal places of what `rack check` prints."""
    answer = ANSWERS[EXERCISES.index("7-rate")]
    page = (COURSE / "7-rate" / "README.md").read_text()
    table = re.findall(r"^\| (\d+) \| ([\d.]*) ?\| ([\d.]*) ?\|", answer, re.MULTILINE)
    for column, text in ((1, page), (2, answer)):
        shown = re.findall(r"^(\d+) Hz: (\S+) mrad RMS", text, re.MULTILINE)
        assert shown
        assert sorted(shown) == sorted((row[0], row[column]) for row in table if row[column])


def test_a_number_that_varies_is_above_zero_and_the_same_twice() -> None:
    assert is_shown("late: N of N cycles, ... skipped", "late: 12 of 12 cycles, 3 of them skipped")
    assert not is_shown("late: N of N cycles", "late: 12 of 123 cycles")
    assert not is_shown("reads: N torn", "reads: 0 torn")
