"""The recorder takes everything that was written, in order, without influence on the run."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.words import Head, System
from rack.boards import Rack
from rack.boards.config import RackConfig
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.current_run import find_run_folder
from rack.tools.recording.recorder.recorder import Recorder
from rack.tools.recording.recording import Recording
from rack.tools.report.report import build_report
from tests.shared_runs import SMALL_S

TICKS = 1600


@pytest.fixture(scope="module")
def recording(run: Path) -> Recording:
    return Recording(run)


def test_every_message_and_every_cycle_is_recorded(recording: Recording) -> None:
    report = build_report(recording)
    assert report["recording"] == "complete"
    assert not any(recording.lost_rows.values())
    boxes = {"upper.command", "upper.status", "lower.status", "lower.plan"}
    assert set(recording.mailboxes) == boxes
    for mailbox in recording.mailboxes:
        serials = recording.read_signal(mailbox, "serial")
        assert np.array_equal(serials, np.arange(1, len(serials) + 1))
    assert len(recording.read_signal("lower.status", "serial")) == TICKS
    assert {task: len(rows) for task, rows in recording.cycles.items()} == {
        "upper": report["tasks"]["upper"]["cycles"],
        "lower": report["tasks"]["lower"]["cycles"],
        "lower.planner": report["tasks"]["lower.planner"]["plans"],
    }


@pytest.mark.slow
def test_recording_changes_nothing_in_a_run(config: RackConfig, recording: Recording) -> None:
    unrecorded = run_rack(config, SMALL_S, None, Display())
    assert unrecorded.outcome.digest == build_report(recording)["digest"]


@pytest.mark.slow
@pytest.mark.parametrize("is_same_namespace", [True, False])
def test_lockstep_does_not_wait_for_a_recorder_in_another_pid_namespace(
    config: RackConfig, tmp_path: Path, is_same_namespace: bool
) -> None:
    with Rack(config) as rack:
        words = rack.segment.words
        namespace = words[Head.LAUNCHER_NAMESPACE]
        words[Head.LAUNCHER_NAMESPACE] += not is_same_namespace
        try:
            with Recorder(rack.segment, tmp_path):
                assert words[System.FOLLOWER_PID] == (os.getpid() if is_same_namespace else 0)
                found = find_run_folder(rack.segment)
                assert found == (tmp_path if is_same_namespace else None)
        finally:
            words[Head.LAUNCHER_NAMESPACE] = namespace
