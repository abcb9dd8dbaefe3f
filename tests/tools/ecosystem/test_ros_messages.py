"""Tests the ROS messages that rows of a rack's rings become. On a whole run: test_rosbag2.py."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.backplane.layout import Layout
from rack.backplane.mailbox.history import build_row_dtype
from rack.backplane.message import State
from rack.backplane.trace import RECORD, SKIPPED_SHIFT, Flag
from rack.boards.config import load, resolve_layout
from rack.tools.ecosystem.ros_messages import STORE, RosEncoder, RosMessage, convert_name

EPOCH_NS = 1_700_000_000 * 10**9
TICK_NS = 2_500_000
TICKS_PER_SECOND = 400


@pytest.fixture
def layout(small: Path) -> Layout:
    return resolve_layout(load(small, []))


@pytest.fixture
def encoder(small: Path, layout: Layout) -> RosEncoder:
    return RosEncoder(layout, load(small, []), EPOCH_NS)


def encode(encoder: RosEncoder, ring: str, rows: np.ndarray) -> list[RosMessage]:
    (source,) = [source for source in encoder.sources if source.ring == ring]
    return [*encoder.encode(source, rows)]


def decode(message: RosMessage) -> Any:
    return STORE.deserialize_cdr(message.data, message.topic.type_name)


def test_a_rack_without_an_arm_has_neither_joints_nor_poses(encoder: RosEncoder) -> None:
    topics = [(source.ring, source.topic.name) for source in encoder.sources]
    assert sorted(topics) == [
        ("lower", "/diagnostics"),
        ("lower.planner", "/diagnostics"),
        ("lower.status", "/rack/lower/status"),
        ("upper", "/diagnostics"),
        ("upper.status", "/rack/upper/status"),
    ]


@pytest.mark.parametrize(
    ("flags", "level", "text"),
    [
        (0, 0, "0 missed, 0 skipped of 3 cycles"),
        (Flag.MISSED, 1, "1 missed, 0 skipped of 3 cycles"),
        (Flag.SKIPPED | 2 << SKIPPED_SHIFT, 1, "0 missed, 2 skipped of 3 cycles"),
        (Flag.MISSED | Flag.BUS_ERROR, 2, "1 missed, 0 skipped of 3 cycles"),
        (Flag.CORRUPT, 2, "0 missed, 0 skipped of 3 cycles"),
    ],
)
def test_diagnostics_warn_of_misses_and_report_errors_of_the_bus(
    encoder: RosEncoder, flags: int, level: int, text: str
) -> None:
    rows = np.zeros(4, RECORD)
    # The last one is in the next second.
    rows["tick"] = [0, 1, 2, TICKS_PER_SECOND]
    rows["release_ns"] = rows["tick"] * TICK_NS
    rows["end_ns"] = rows["release_ns"] + [300_000, 1_250_000, 200_000, 100_000]
    rows["flags"][1] = flags
    first, second = map(decode, encode(encoder, "lower", rows))
    (status,) = first.status
    values = {pair.key: pair.value for pair in status.values}
    assert (status.name, status.level, status.message) == ("small: lower", level, text)
    assert values["longest_response_ms"] == "1.25"
    assert values["period_ms"] == "2.5"
    assert second.status[0].message == "0 missed, 0 skipped of 1 cycles"
    assert (second.header.stamp.sec, second.header.stamp.nanosec) == (1_700_000_001, 0)


@pytest.mark.parametrize(
    ("state", "error", "reason", "level", "text"),
    [
        (State.EXECUTING, 0, b"", 0, "executing"),
        (State.HOLDING, 0, b"lower is lost", 1, "holding: lower is lost"),
        (State.ERROR, 0, b"", 2, "error"),
        (State.DONE, 7, b"limit", 2, "done: limit"),
    ],
)
def test_status_has_the_state_and_its_reason(
    layout: Layout,
    encoder: RosEncoder,
    state: State,
    error: int,
    reason: bytes,
    level: int,
    text: str,
) -> None:
    rows = np.zeros(17, build_row_dtype(layout.find_mailbox("lower.status")))
    rows["tick"] = np.arange(17)
    message = rows["message"]
    message["state"], message["error"], message["reason"] = state, error, reason
    found = encode(encoder, "lower.status", rows)
    # The first row of each interval of 20 ms.
    assert [m.time_ns - EPOCH_NS for m in found] == [0, 8 * TICK_NS, 16 * TICK_NS]
    status = decode(found[0])
    assert (status.level, status.message) == (level, text)
    assert {pair.key: pair.value for pair in status.values}["error"] == str(error)


def test_no_rows_become_no_messages(layout: Layout, encoder: RosEncoder) -> None:
    assert encode(encoder, "lower", np.zeros(0, RECORD)) == []
    box = layout.find_mailbox("lower.status")
    assert encode(encoder, "lower.status", np.zeros(0, build_row_dtype(box))) == []


@pytest.mark.parametrize(
    ("kind", "severity"), [("fault", 30), ("detection", 30), ("died", 40), ("recovery", 20)]
)
def test_events_become_entries_of_the_log(encoder: RosEncoder, kind: str, severity: int) -> None:
    event = {"kind": kind, "board": "", "tick": 400, "text": "it happened", "code": "code"}
    (message,) = encoder.encode(encoder.log, [event])
    log = decode(message)
    assert (log.level, log.name, log.msg) == (severity, "small", f"{kind}: it happened")
    assert (log.stamp.sec, log.function) == (1_700_000_001, "code")


def test_names_of_topics_are_valid() -> None:
    assert convert_name("cell-1.status") == "cell_1/status"
