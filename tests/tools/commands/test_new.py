"""Tests `rack new`: the written files run, and pass their test, without changes."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Sequence
from itertools import count
from pathlib import Path

import pytest

from rack.tools.commands.new import TEMPLATES
from tests.processes import run_to_end
from tests.tools.command_line import BOUND_S, rack, read_answer, read_refusal

KINDS = ("level", "servo", "planner")
NO_NAMES = ("", "3d", "class", "a-b", "../up", "Upper", "a" * 41)


NUMBERS = count()


@pytest.fixture
def name() -> str:
    """A name that no module of this process and no other rack has."""
    return f"soft_touch_{os.getpid()}_{next(NUMBERS)}"


@pytest.mark.usefixtures("without_templates")
@pytest.mark.parametrize("kind", KINDS)
def test_it_writes_a_class_a_config_and_a_test_with_the_users_name(
    kind: str, name: str, tmp_path: Path
) -> None:
    assert rack("new", kind, f"my_{kind}", folder=tmp_path).returncode == 0
    made = read_answer("new", kind, name, folder=tmp_path)
    files = [tmp_path / file for file in made["files"]]
    assert sorted(files) == sorted((tmp_path / name).iterdir())
    assert {file.name for file in files} == {f"{name}.py", f"{name}.toml", f"test_{name}.py"}
    assert not [file for file in files if re.search(f"my_{kind}|My[A-Z]", file.read_text())]
    camel = name.title().replace("_", "")
    assert f"class {camel}(" in (tmp_path / name / f"{name}.py").read_text()
    done = rack("check", f"{name}/{name}.toml", folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["servo", "planner"])
def test_the_written_files_run(kind: str, name: str, tmp_path: Path) -> None:
    """The next test but one runs a level."""
    assert rack("new", kind, name, folder=tmp_path).returncode == 0
    words = ("--lockstep", "--seconds", "0.2", "--no-record")
    done = rack("run", f"{name}/{name}.toml", *words, folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.thorough
@pytest.mark.parametrize(
    "kinds",
    # A planner comes with an executor.
    [("planner",), KINDS],
    ids=["planner", "all"],
)
def test_the_written_files_pass_their_tests(
    kinds: Sequence[str], name: str, tmp_path: Path
) -> None:
    names = [f"{name}_{kind}" for kind in kinds]
    for kind, each in zip(kinds, names, strict=True):
        hint = f"  rack run {each}/{each}.toml --lockstep --seconds 2\n  pytest {each}\n"
        assert hint in rack("new", kind, each, folder=tmp_path).stdout
    test = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *names]
    tested = run_to_end(test, BOUND_S, cwd=tmp_path)
    assert f"{len(kinds)} passed" in tested.stdout, tested.stdout + tested.stderr


@pytest.mark.slow
def test_a_new_level_reports_its_own_event_once_its_live_limit_is_set(
    name: str, tmp_path: Path
) -> None:
    rack("new", "level", name, folder=tmp_path)
    setting = f"command=[{{level='{name}', what='set', name='limit=0.01', tick=400}}]"
    run = [name, "--lockstep", "--seconds", "6", "--set", setting, "--out", "recorded"]
    done = rack("run", *run, folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "a joint is faster than the limit" in done.stderr
    report = json.loads((tmp_path / "recorded" / "report.json").read_text())
    (found,) = (one for one in report["unexplained"] if one["code"] == "fast")
    assert found["board"] == name
    assert found["text"].startswith("fast: 0.0")
    assert "rad/s, a joint is faster than the limit" in found["text"]
    schema = rack("schema", f"board.{name}.findings", "--config", name, folder=tmp_path)
    assert "a joint is faster than the limit" in schema.stdout


@pytest.mark.parametrize(
    ("name", "why"),
    [
        *((name, "must be at most 40 of a-z, 0-9 and '_'") for name in NO_NAMES),
        ("json", "an installed module has that name"),
        ("nasrem", "a bundled config, or a board of nasrem, has that name"),
        ("servo", "a bundled config, or a board of nasrem, has that name"),
        ("executor", "its class would be named Executor, as a class that it uses"),
        ("answering", "its class would be named AnsweringStatus, as a class that it uses"),
    ],
)
def test_an_unusable_name_is_refused_in_one_line(name: str, why: str, tmp_path: Path) -> None:
    refusal = read_refusal(rack("new", "level", name, folder=tmp_path))
    assert refusal.startswith(f'NAME = "{name}": {why}')
    assert not [*tmp_path.iterdir()]


def test_an_existing_folder_is_not_changed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "mine.py").write_text("mine")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "nowhere").symlink_to("missing")
    for taken in ("mine", "file", "nowhere"):
        done = rack("new", "level", "mine", "--out", taken, folder=tmp_path)
        assert f"'{taken}' exists already" in read_refusal(done)
    assert [*(tmp_path / "mine").iterdir()] == [tmp_path / "mine" / "mine.py"]
    assert (tmp_path / "mine" / "mine.py").read_text() == "mine"


@pytest.mark.parametrize("kind", KINDS)
def test_each_template_is_three_files(kind: str) -> None:
    expected = {f"my_{kind}.py", f"my_{kind}.toml", f"test_my_{kind}.py"}
    assert {path.name for path in (TEMPLATES / kind).iterdir() if path.is_file()} == expected
