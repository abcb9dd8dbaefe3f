"""`rack record` on a running rack; the viewer without a screen, `rack replay` without a recording."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.tools.analysis.report import write_report
from rack.tools.console.answer import Failure
from rack.tools.replay import replay
from rack.tools.runs.recording import Recording
from rack.tools.runs.window import ViewerWindow
from rack.tools.viewer.reading import read
from tests.processes import RACK

ROOT = Path(__file__).resolve().parents[2]
WATCHDOG_S = 50.0


def test_a_rack_that_runs_can_be_recorded_until_its_end(small: Path, rack_name: str, tmp_path: Path) -> None:
    config = load(small, [f"name={rack_name}", "clock.mode=realtime"])
    with Rack(config) as rack:
        rack.start()
        command = [*RACK, "record", rack_name, "--out", str(tmp_path / "run"), "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as recorder:
            deadline = time.monotonic() + WATCHDOG_S
            while not (tmp_path / "run" / "run.rrd").is_file() and time.monotonic() < deadline:
                rack.watch(0.1)
            rack.stop("recorded")
            while rack.watch(0.5):
                continue
            answer = json.loads(recorder.communicate(timeout=WATCHDOG_S)[0])
    assert recorder.returncode == 0
    assert answer == {"rack": rack_name, "folder": str(tmp_path / "run"), "notes": []}
    assert rack.outcome is not None
    report, _ = write_report(tmp_path / "run")
    assert report["rack"] == rack_name
    assert report["tasks"]["lower"]["traced"] > 0
    ticks = Recording(tmp_path / "run").signal("lower.status", "tick")
    assert ticks[-1] == rack.outcome.ticks - 1
    assert read(tmp_path / "run" / "run.rrd", "/signals/lower.status/count").ticks.tolist() == ticks.tolist()


def test_a_window_without_a_screen_says_what_to_do_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(Failure, match=r"no screen: .*: rerun run\.rrd"):
        ViewerWindow("run.rrd")


def test_a_folder_without_a_recording_is_no_run_to_replay(tmp_path: Path) -> None:
    with pytest.raises(Failure, match=r"it has no run\.rrd"):
        replay([tmp_path])
