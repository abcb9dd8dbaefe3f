"""The stored report of a run is shown while it is newer than recording and program."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rack.tools.recording.checksums import Checksums
from rack.tools.report import stored
from rack.tools.report.report import OtherRun, write_report
from rack.tools.report.stored import RECORDED_FILES, read_stored_report
from tests.shared_runs import small_run
from tests.tools.command_line import rack, read_answer


@pytest.fixture
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = small_run(tmp_path_factory)
    write_report(run)
    return run


def make_newer(path: Path) -> None:
    """Set the modification time of a file after all others."""
    later_ns = time.time_ns() + 10**9
    os.utime(path, ns=(later_ns, later_ns))


def cut_off(path: Path) -> None:
    path.write_text('{"rack": ')
    path.with_suffix(".md").touch()


CHANGES: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "newer": (make_newer, tuple(RECORDED_FILES)),
    "missing": (
        lambda path: path.rename(path.with_name("elsewhere")),
        ("report.json", "report.md", *RECORDED_FILES),
    ),
    "there": (Path.touch, (stored.SPOOL,)),
    "damaged": (cut_off, ("report.json",)),
}
CASES = [(change, name) for change, names in CHANGES.values() for name in names]


@pytest.mark.parametrize(("change", "name"), CASES)
def test_a_stored_report_is_shown_until_a_file_changes(
    folder: Path, change: Callable[[Path], object], name: str
) -> None:
    assert read_stored_report(folder) == write_report(folder)[0]
    change(folder / name)
    assert read_stored_report(folder) is None


def test_a_report_is_rebuilt_when_the_program_changes(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored, "PROGRAM_FOLDER", tmp_path)
    (tmp_path / "levels").mkdir()
    changed = tmp_path / "levels" / "level.py"
    changed.touch()
    os.utime(changed, ns=(0, 0))
    assert read_stored_report(folder) is not None
    make_newer(changed)
    assert read_stored_report(folder) is None


def test_a_report_is_rebuilt_in_another_folder_and_after_a_comparison(folder: Path) -> None:
    write_report(folder, OtherRun(folder, "", True))
    assert read_stored_report(folder) is None
    write_report(folder)
    moved = folder.with_name(f"{folder.name}-moved")
    folder.rename(moved)
    assert read_stored_report(moved) is None


def test_the_command_rebuilds_a_report_only_when_necessary(folder: Path) -> None:
    report = json.loads((folder / "report.json").read_text())
    (folder / "report.json").write_text(json.dumps(report | {"digest": "as stored"}))
    Checksums(folder).store("report.*")
    assert read_answer("report", folder)["digest"] == "as stored"
    assert "Digest `as stored`." in rack("report", folder, "--full").stdout
    make_newer(folder / "events.jsonl")
    assert read_answer("report", folder) == report
    assert json.loads((folder / "report.json").read_text()) == report
