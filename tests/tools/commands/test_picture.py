"""Tests `rack picture`: the first view, one of its views, and what it says if it cannot."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from tests.tools.command_line import rack, read_refusal


@pytest.mark.thorough
def test_the_first_view_and_one_of_its_views_are_drawn(run: Path, tmp_path: Path) -> None:
    # A run of a flight recorder has no run.rrd.
    (run / "run.rrd").rename(tmp_path / "run.rrd")
    shown = rack("picture", run, "--at", 3)
    (tmp_path / "run.rrd").rename(run / "run.rrd")
    if shown.stderr.startswith("no picture: "):
        pytest.skip(shown.stderr)
    assert shown.stdout.splitlines()[0] == f"picture: {run / 'picture-3s.png'}"
    path = tmp_path / "ages.png"
    # This view is in a tab behind another one.
    shown = rack("picture", run, "--at", 3, "--view", "plan age", "--out", path)
    assert (shown.returncode, shown.stderr.splitlines()[1:]) == (0, [])
    with Image.open(run / "picture-3s.png") as whole, Image.open(path) as part:
        assert part.width < whole.width
        assert len(part.convert("RGB").getcolors(1 << 24) or ()) > 10


@pytest.mark.slow
def test_without_a_driver_the_cause_and_what_to_do_are_one_line(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, "/nowhere")
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    shown = rack("picture", run, "--at", 1, "--out", tmp_path / "out.png")
    assert (shown.returncode, shown.stdout) == (1, "")
    line = shown.stderr.splitlines()[-1]
    assert line.startswith("no picture: ")
    assert "No graphics adapter was found" in line
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--at", "4"), "--at 4.0: must be 0 to 3.9975 s"),
        (("--at", "nan"), "--at nan: must be 0 to 3.9975 s"),
        (("--at", "1", "--out", "a.jpg"), "--out a.jpg: the name of a picture must end in .png"),
        (("--at", "1", "--out", "nowhere/a.png"), '"nowhere/a.png": No such file or directory'),
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    run: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    assert read_refusal(rack("picture", run, *words, folder=tmp_path)) == message
