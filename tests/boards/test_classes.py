"""Classes of levels by name: found, and refused in one line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rack.boards.config.loader import extend_path
from rack.levels.level import Executor, Planner
from rack.levels.references import find_class
from rack.levels.servo import ServoExecutor


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the import path for a while."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    extend_path([tmp_path])
    return tmp_path


def test_a_class_is_found_by_its_name() -> None:
    assert find_class("rack.levels.servo:ServoExecutor", Executor) is ServoExecutor


def test_a_folder_is_put_on_the_import_path_once(folder: Path) -> None:
    extend_path([folder, folder])
    assert sys.path.count(str(folder)) == 1
    assert sys.path[-1] == str(folder)


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("Servo", "module 'rack.levels.servo' has no class 'Servo'; it has: "),
        ("ServoExecutor", "module 'rack.levels.servo' has no Planner named 'ServoExecutor'; it "),
        ("__name__", "module 'rack.levels.servo' has no Planner named '__name__'; it has: "),
    ],
)
def test_an_unknown_class_is_refused_with_the_existing_ones(name: str, why: str) -> None:
    with pytest.raises(LookupError) as error:
        find_class(f"rack.levels.servo:{name}", Planner)
    assert str(error.value).startswith(why)
    assert str(error.value).endswith(" it has: ServoPlanner")


def test_a_module_without_suitable_classes_is_refused() -> None:
    with pytest.raises(LookupError, match=r"it has: none$"):
        find_class("rack.levels.errors:Level", Executor)


@pytest.mark.slow
def test_a_module_that_would_end_the_process_is_tried_elsewhere_first(folder: Path) -> None:
    (folder / "ends_its_process.py").write_text("import os\nos._exit(7)\n")
    with pytest.raises(LookupError, match=r"ends_its_process.*it ended the process"):
        find_class("ends_its_process:Level", Executor)
