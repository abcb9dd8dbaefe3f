"""Interrupts as users see them: in `rack status`, in the report of a run, and message by
message."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.tools.lab.benches.exchange_times import ExchangeTimes, exchange_times
from rack.tools.live.interrupts import Inboxes, replayed
from rack.tools.live.snapshot import RackMonitor
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.report import write_report
from tests.boards.messages import Written
from tests.boards.run.test_interrupts import BOARDS, OVERLOADED, RACK, SECONDS, SMALL, TICKS
from tests.tools.recordings import recorded as write_recording


def recorded(folder: Path, name: str, *settings: str) -> Recording:
    """Run the rack of tests of interrupts, and return its recording, without waiting for a recorder
    to start."""
    path = folder / "hub.toml"
    path.write_text(RACK)
    config = load(path, [f"name={name}", *settings])
    with Rack(config) as rack:
        rack.run(SECONDS)
        found = Written.on(rack.segment)
    traces = {task: rows.tolist() for task, rows in found.cycles.items()}
    return write_recording(folder / "run", config, traces, messages=found.messages)


def times(recording: Recording) -> dict[str, ExchangeTimes]:
    """Return the times of what the hub reads, by writer."""
    return {one.writer: one for one in exchange_times(recording) if one.reader == "hub"}


@pytest.mark.slow
def test_status_shows_every_inbox(tmp_path: Path, rack_name: str) -> None:
    path = tmp_path / "hub.toml"
    path.write_text(RACK)
    with Rack(load(path, [f"name={rack_name}", SMALL])) as rack:
        (empty,) = Inboxes(rack.segment).look()
        assert empty.line == "interrupts of hub: 0 served, at most 0 of 2 waited"
        rack.run(SECONDS)
        (full,) = RackMonitor(rack.segment).look().inboxes
    assert (
        full.line
        == f"interrupts of hub: {3 * (TICKS - 1)} served, at most 2 of 2 waited, {2 * (TICKS - 1)}"
        " lost"
    )


@pytest.mark.slow
@pytest.mark.parametrize("settings", [(SMALL,), (SMALL, OVERLOADED)], ids=["burst", "overload"])
def test_a_recording_tells_what_the_board_itself_had(
    tmp_path: Path, rack_name: str, settings: tuple[str, ...]
) -> None:
    recording = recorded(tmp_path, rack_name, *settings)
    board = replayed(recording, recording.layout.task("hub").slot)
    had = recording.signal("hub.status", "cycle")
    for at in range(BOARDS):
        ends = board.mailboxes[f"figure{at}.status"].end_ns
        shown = [np.flatnonzero(ends <= tick * recording.layout.clock_ns) for tick in range(TICKS)]
        # A board writes in every tick, so the number of a message is its tick.
        assert had[:, at].tolist() == [found[-1] if len(found) else -1 for found in shown]


@pytest.mark.slow
def test_the_report_holds_losses_and_latencies(tmp_path: Path, rack_name: str) -> None:
    recorded(tmp_path, rack_name, SMALL)
    report, text = write_report(tmp_path / "run")
    (inbox,) = report["interrupts"]
    assert (inbox["board"], inbox["depth"], inbox["waiting"]) == ("hub", 2, 2)
    assert (inbox["served"], inbox["lost"]) == (3 * TICKS, 2 * TICKS)
    assert inbox["latency_us"]["max"] == 3 * inbox["latency_us"]["min"]
    assert (
        f"Interrupts of hub: {3 * TICKS} messages served, at most 2 waiting, room for 2,"
        f" {2 * TICKS} lost" in text
    )


@pytest.mark.slow
def test_interrupts_come_at_even_times_and_a_tick_old(tmp_path: Path, rack_name: str) -> None:
    found = times(recorded(tmp_path, rack_name, SMALL))
    assert {name: one.lost for name, one in found.items()} == {
        "figure0": TICKS,
        "figure1": TICKS,
        **{f"figure{at}": 0 for at in range(2, BOARDS)},
    }
    for one in found.values():
        assert (one.mailbox, one.protocol, one.sent, one.overtaken) == (
            f"{one.writer}.status",
            "interrupt",
            TICKS,
            0,
        )
    first, last = found["figure4"], found["figure0"]
    assert first.jitter_ms is not None
    assert first.age_ms is not None
    assert (first.jitter_ms["max"], first.age_ms["min"], first.age_ms["max"]) == (0.0, 2.5, 2.5)
    assert last.jitter_ms is last.age_ms is None


@pytest.mark.slow
def test_an_overloaded_handler_makes_arrivals_uneven_and_old(
    tmp_path: Path, rack_name: str
) -> None:
    found = times(recorded(tmp_path, rack_name, OVERLOADED))
    jitter = [one.jitter_ms["max"] for one in found.values() if one.jitter_ms is not None]
    ages = [one.age_ms["p50"] for one in found.values() if one.age_ms is not None]
    assert max(jitter) > 0.5
    assert max(ages) > 10.0


@pytest.mark.slow
def test_messages_visible_at_once_are_measured_alike(tmp_path: Path, rack_name: str) -> None:
    found = times(recorded(tmp_path, rack_name, "protocol.default=double-buffer"))
    assert len(found) == BOARDS
    for one in found.values():
        assert (one.protocol, one.sent, one.lost) == ("double-buffer", TICKS, 0)
        assert one.jitter_ms is not None
        assert one.age_ms is not None
        # In lockstep the hub, which is released first, reads what the tick before has left.
        assert (one.jitter_ms["max"], one.age_ms["p50"]) == (0.0, 2.5)


@pytest.mark.slow
def test_a_slow_reader_is_overtaken(tmp_path: Path, rack_name: str) -> None:
    found = times(
        recorded(tmp_path, rack_name, "board.hub.every=10", "protocol.default=time-slice")
    )
    for one in found.values():
        assert (one.protocol, one.sent, one.lost) == ("time-slice", TICKS, 0)
        # Of ten messages it sees one.
        assert one.overtaken == 90 - 1 - 8
        assert one.jitter_ms is not None
        assert one.jitter_ms["max"] == 0.0


@pytest.mark.slow
def test_real_time_without_ticks_is_measured_by_the_clock(tmp_path: Path, rack_name: str) -> None:
    modes = ("clock.mode=realtime", "protocol.default=double-buffer")
    for one in times(recorded(tmp_path, rack_name, *modes)).values():
        assert one.jitter_ms is not None
        assert one.jitter_ms["max"] > 0.0
        assert one.age_ms is not None
        assert one.age_ms["max"] >= 0.0
