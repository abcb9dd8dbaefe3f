"""The recorder: everything that was written, in order, and no trace of itself in what was
written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.layout import MailboxSpec
from rack.backplane.message import Field, MessageType
from rack.backplane.words import Head, System
from rack.boards import Rack
from rack.boards.config import load
from rack.boards.config.layout import field_specs
from rack.tools.console.answer import Failure
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack
from rack.tools.recording.parquet import columns_of
from rack.tools.recording.recorder.recorder import Recorder
from rack.tools.recording.recorder_process import recorded_by
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.report import report_of
from tests.shared_runs import SMALL_S, small_run

TICKS = 1600
POINT = MessageType(
    "point", 1, (Field("at", "f8", "m", "place", (3,)), Field("id", "u2", "1", "number"))
)
PATH = MessageType(
    "path",
    1,
    (
        Field("count", "u2", "1", "points"),
        Field("points", POINT, "", "way", (4,)),
        Field("why", "S8", "", ""),
    ),
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording(small_run(tmp_path_factory))


def test_every_message_and_every_cycle_is_recorded(recording: Recording) -> None:
    report = report_of(recording)
    assert report["recording"] == "complete"
    assert not any(recording.lost.values())
    boxes = {"upper.command", "upper.status", "lower.status", "lower.plan"}
    assert set(recording.mailboxes) == boxes
    for mailbox in recording.mailboxes:
        serials = recording.signal(mailbox, "serial")
        assert np.array_equal(serials, np.arange(1, len(serials) + 1))
    assert len(recording.signal("lower.status", "serial")) == TICKS
    assert {task: len(rows) for task, rows in recording.cycles.items()} == {
        "upper": report["tasks"]["upper"]["cycles"],
        "lower": report["tasks"]["lower"]["cycles"],
        "lower.planner": report["tasks"]["lower.planner"]["plans"],
    }


@pytest.mark.slow
def test_recording_changes_nothing_in_a_run(
    small: Path, rack_name: str, recording: Recording
) -> None:
    unrecorded = run_rack(load(small, [f"name={rack_name}"]), SMALL_S, None, Display())
    assert unrecorded.outcome.digest == report_of(recording)["digest"]


@pytest.mark.slow
@pytest.mark.parametrize("is_same_namespace", [True, False])
def test_lockstep_waits_for_no_recorder_of_another_pid_namespace(
    small: Path, rack_name: str, tmp_path: Path, is_same_namespace: bool
) -> None:
    with Rack(load(small, [f"name={rack_name}"])) as rack:
        words = rack.segment.words
        namespace = words[Head.LAUNCHER_NAMESPACE]
        words[Head.LAUNCHER_NAMESPACE] += not is_same_namespace
        try:
            with Recorder(rack.segment, tmp_path):
                assert words[System.FOLLOWER_PID] == (os.getpid() if is_same_namespace else 0)
                found = recorded_by(rack.segment)
                assert found == (tmp_path if is_same_namespace else None)
        finally:
            words[Head.LAUNCHER_NAMESPACE] = namespace


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Failure, match="not a run: it has no config"):
        Recording(tmp_path)


def test_groups_of_fields_become_one_column_a_field() -> None:
    sizes: dict[str, int] = {}
    box = MailboxSpec(
        name="a.path",
        writer="a",
        readers=(),
        protocol="time-slice",
        every=1,
        delay=1,
        depth=4,
        message="path",
        version=1,
        size=PATH.dtype(sizes).itemsize,
        fields=field_specs(PATH, sizes),
    )
    rows = np.zeros(5, PATH.dtype(sizes))
    rows["points"]["at"] = np.arange(60.0).reshape(5, 4, 3)
    rows["points"]["id"] = np.arange(20).reshape(5, 4)
    rows["why"] = b"because"
    columns = {column.name: column for column in columns_of(box)}
    assert {name: column.shape for name, column in columns.items()} == {
        "a.path.count": (),
        "a.path.points.at": (4, 3),
        "a.path.points.id": (4,),
        "a.path.why": (),
    }
    assert columns["a.path.points.at"].array(rows)[2].as_py() == list(np.arange(24.0, 36.0))
    assert columns["a.path.points.id"].array(rows)[4].as_py() == [16, 17, 18, 19]
    assert columns["a.path.why"].array(rows).to_pylist() == ["because"] * 5
    # A message that was damaged on its way is recorded too.
    rows["why"][3] = b"bec\x80use"
    assert columns["a.path.why"].array(rows).to_pylist()[3] == "bec\ufffduse"
