"""Tests traces for Perfetto: decoded with its own classes, and by SQL in its trace processor."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent

from rack.backplane.mailbox.history import build_row_dtype
from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.boards.config import RackConfig, load, resolve_layout
from rack.tools.ecosystem.perfetto_trace import export_trace
from rack.tools.recording.recording import Recording
from tests.pages import ROOT
from tests.tools.ecosystem.trace_processor import open_trace
from tests.tools.recordings import MS, Cycle, Row, recorded

PLAIN = (0.0, 0.1, 0.3, 0.2)
TICK_NS = 2_500_000
PERIOD = 8
"""Period of the upper level, in ticks. The lower one runs in every tick."""
MISSED = 1300
PLAN = 24
"""Tick of the only plan, during which its executor runs twice."""
END = 1320
PAGE = ROOT / "tools" / "NEIGHBOURS.md"


class Slice(NamedTuple):
    """A slice, or an instant, whose end is its start."""

    track: str
    depth: int
    name: str
    start: int
    end: int


@pytest.fixture
def recording(small: Path, tmp_path: Path) -> Recording:
    """Two levels in real time. The lower one misses a deadline and skips the next release."""
    config = load(small, ["clock.mode=realtime"])
    lower: list[Cycle | Row] = [Cycle(tick, PLAIN) for tick in range(END) if tick != MISSED + 1]
    lower[MISSED] = Cycle(MISSED, (0.0, 0.1, 3.0, 0.2), flags=int(Flag.MISSED))
    lower[MISSED + 1] = Cycle(MISSED + 2, PLAIN, flags=int(Flag.SKIPPED) | 1 << SKIPPED_SHIFT)
    upper = [Cycle(tick, PLAIN, late=1.0) for tick in range(0, END, PERIOD)]
    plan = Cycle(PLAN, (0.0, 0.1, 4.0, 0.2), late=1.0, flags=int(Flag.PLANNED))
    traces = {"lower": lower, "upper": upper, "lower.planner": [plan]}
    event = {"board": "lower", "tick": 40, "code": "begins", "subject": "", "text": "kill begins"}
    event |= {"kind": "fault", "time_ns": 40 * TICK_NS}
    return recorded(tmp_path / "run", config, traces, [event], write_messages(config))


def write_messages(config: RackConfig) -> dict[str, np.ndarray]:
    """Return a status of the lower level for each of its cycles, written at the cycle's end."""
    rows = np.zeros(END, build_row_dtype(resolve_layout(config).find_mailbox("lower.status")))
    rows["tick"] = rows["serial"] = ticks = np.arange(END)
    rows["visible_at"] = ticks + 1
    rows["stamp_ns"] = ticks * TICK_NS + MS // 2
    return {"lower.status": rows}


def export(recording: Recording) -> Path:
    path = recording.folder / "run.pftrace"
    shown: list[float] = []
    count = export_trace(recording, path, shown.append)
    assert count > 0
    assert shown[-1] == 1.0
    return path


def decode(path: Path) -> tuple[list[Slice], dict[int, Slice], dict[int, Slice]]:
    """Return all slices, and the slices at which each arrow begins and ends."""
    names: dict[int, str] = {}
    stacks: dict[int, list[tuple[str, int, list[int]]]] = defaultdict(list)
    slices: list[Slice] = []
    begins: dict[int, Slice] = {}
    ends: dict[int, Slice] = {}
    for packet in Trace.FromString(path.read_bytes()).packet:
        if packet.HasField("track_descriptor"):
            names[packet.track_descriptor.uuid] = packet.track_descriptor.name
            continue
        event = packet.track_event
        stack = stacks[event.track_uuid]
        track = names[event.track_uuid]
        if event.type == TrackEvent.TYPE_SLICE_BEGIN:
            arrows = list(event.terminating_flow_ids)
            stack.append((event.name, packet.timestamp, arrows))
        elif event.type == TrackEvent.TYPE_SLICE_END:
            name, start, arrows = stack.pop()
            slices.append(Slice(track, len(stack), name, start, packet.timestamp))
            ends |= dict.fromkeys(arrows, slices[-1])
        else:
            slices.append(Slice(track, 0, event.name, packet.timestamp, packet.timestamp))
            begins |= dict.fromkeys(event.flow_ids, slices[-1])
    assert not any(stacks.values())
    return slices, begins, ends


def test_a_cycle_contains_reading_processing_and_writing(recording: Recording) -> None:
    slices, _, _ = decode(export(recording))
    start = 7 * TICK_NS
    of_cycle = [s for s in slices if s.track == "lower" and start <= s.start < start + TICK_NS]
    assert [s for s in of_cycle if s.start != s.end] == [
        Slice("lower", 1, "read", start, start + MS // 10),
        Slice("lower", 1, "process", start + MS // 10, start + 4 * MS // 10),
        Slice("lower", 1, "write", start + 4 * MS // 10, start + 6 * MS // 10),
        Slice("lower", 0, "cycle", start, start + 6 * MS // 10),
    ]
    assert [s.name for s in slices if s.track == "upper"].count("cycle") == END // PERIOD


def test_misses_skips_and_faults_are_instants_on_their_board(recording: Recording) -> None:
    slices, _, _ = decode(export(recording))
    marks = {
        (s.track, s.name, s.start)
        for s in slices
        if s.start == s.end and s.name in ("missed", "skipped", "fault")
    }
    ended = MISSED * TICK_NS + 33 * MS // 10
    assert marks == {
        ("lower", "missed", ended),
        ("lower", "skipped", (MISSED + 2) * TICK_NS),
        ("lower", "fault", 40 * TICK_NS),
    }


def test_arrows_lead_from_the_newest_visible_message_to_its_reader(recording: Recording) -> None:
    _, begins, ends = decode(export(recording))
    assert begins.keys() == ends.keys()
    found = {(begins[arrow].name, begins[arrow].start, ends[arrow]) for arrow in begins}
    late = MS
    assert found == {
        (
            "lower.status",
            (tick - 1) * TICK_NS + MS // 2,
            Slice("upper", 1, "read", tick * TICK_NS + late, tick * TICK_NS + late + MS // 10),
        )
        for tick in range(PERIOD, END, PERIOD)
    }


def test_no_arrow_crosses_a_gap_of_a_flight_recorder(small: Path, tmp_path: Path) -> None:
    config = load(small, ["clock.mode=realtime"])
    gap = range(96, 1000)
    lower = [Cycle(tick, PLAIN) for tick in range(END) if tick not in gap]
    upper = [Cycle(tick, PLAIN, late=1.0) for tick in range(0, END, PERIOD) if tick not in gap]
    rows = write_messages(config)["lower.status"]
    messages = {"lower.status": rows[~np.isin(rows["tick"], gap)]}
    run = recorded(tmp_path / "run", config, {"lower": lower, "upper": upper}, (), messages)
    run.kept = [(0, gap.start), (gap.stop, END)]
    _, begins, _ = decode(export(run))
    starts = {mark.start for mark in begins.values()}
    last = (gap.start - 1) * TICK_NS + MS // 2
    assert last not in starts
    assert {last - PERIOD * TICK_NS, (gap.stop + PERIOD - 1) * TICK_NS + MS // 2} <= starts


def test_a_core_shows_executors_within_the_plan_that_they_preempted(recording: Recording) -> None:
    slices, _, _ = decode(export(recording))
    core = [s for s in slices if s.track.startswith("core ") and s.name.startswith("lower")]
    (plan,) = [s for s in core if s.name == "lower.planner"]
    shown = [(s.depth, s.start // TICK_NS) for s in core if s.name == "lower"]
    assert plan.depth == 0
    # The second one outlasts the plan, which is cut off there.
    assert (1, PLAN + 1) in shown
    assert (0, PLAN + 2) in shown
    assert plan.end == (PLAN + 2) * TICK_NS


@pytest.mark.slow
def test_the_query_of_the_page_finds_the_cycle_3_s_before_a_miss(recording: Recording) -> None:
    (sql,) = re.findall(r"```sql\n(.*?)```", PAGE.read_text(), re.DOTALL)
    with open_trace(export(recording)) as trace:
        (row,) = trace.query(sql)
        tick = MISSED - round(3e9 / TICK_NS)
        assert (row["task"], row["tick"]) == ("lower", tick)
        assert (row["ts"], row["dur"]) == (tick * TICK_NS, 6 * MS // 10)
        assert trace.query("select * from stats where severity = 'error' and value > 0") == []


@pytest.mark.thorough
def test_perfetto_reads_a_whole_run(nasrem: Recording) -> None:
    with open_trace(export(nasrem)) as trace:
        rows = trace.query(
            "select track.name as task, count(*) as cycles, sum(dur) as used from slice join track"
            " on track.id = track_id where slice.name = 'cycle' group by 1"
        )
        counted = {row["task"]: (row["cycles"], row["used"]) for row in rows}
        assert counted == {
            task: (len(cycles), int((cycles["end_ns"] - cycles["start_ns"]).sum()))
            for task, cycles in nasrem.cycles.items()
        }
        (arrows,) = trace.query(
            "select count(*) as n, min(reader.ts - message.ts) as least from flow"
            " join slice as message on message.id = slice_out"
            " join slice as reader on reader.id = slice_in"
        )
        assert arrows["n"] > 1000
        assert arrows["least"] >= 0
        assert trace.query("select * from stats where severity = 'error' and value > 0") == []
