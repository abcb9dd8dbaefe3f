"""Racks in lockstep step as one: equal runs whatever the machine does, and clear words where they
cannot."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from rack.boards.crate import heartbeat, patience
from rack.levels.peer import Presence, format_peer_port
from rack.tools.monitor.holds import find_holds
from rack.tools.monitor.newest_messages import NewestMessages
from tests.boards.lan.racks import (
    Ended,
    configs,
    ended,
    ring_texts,
    run_together,
    running,
    started,
    watch,
)
from tests.processes import forked, parent_of, runs, wait_until

pytestmark = pytest.mark.thorough

CYCLE = 8
"""Ticks in a cycle of the adapters, at 50 Hz."""
STEPPED = "clock.mode=lockstep"
KILLED_AT = 10 * CYCLE + 3
KILL = f"""
[[fault]]
board = "lan"
kind = "kill"
tick = {KILLED_AT}
"""


@pytest.fixture
def names(rack_name: str) -> list[str]:
    return [f"{rack_name}-{k}" for k in "abc"]


def digests(found: Sequence[Ended]) -> list[str]:
    """Return the digests of racks, each of which ran to its end."""
    assert {one.outcome.cause for one in found} == {"time over"}, [one.texts for one in found]
    return [one.outcome.digest for one in found]


def load() -> None:
    while True:
        pass


def test_three_racks_repeat_whatever_the_order_of_launches_and_the_load(
    names: list[str], tmp_path: Path
) -> None:
    racks = configs(ring_texts(names), tmp_path, STEPPED)
    first = run_together(racks, [1.0, 1.0, 1.0])
    with forked(load), forked(load):
        second = run_together(racks[::-1], [1.0, 1.0, 1.0])[::-1]
    assert digests(first) == digests(second)
    assert len(set(digests(first))) == 3
    for one in first:
        counts = one.last["lan.status"]["import_other"]
        # In its first cycle an adapter finds nothing to export.
        assert counts["taken"] == 49
        bad = "missing", "repeated", "late", "refused", "unknown_launch", "superseded"
        assert not any(counts[name] for name in bad)
        assert one.last["echo.status"]["total"] == sum(range(48))
        assert one.last["echo.status"]["lost"] == 0


def test_an_adapter_killed_at_a_tick_comes_back_and_the_run_repeats(
    names: list[str], tmp_path: Path
) -> None:
    texts = ring_texts(names[:2])
    racks = configs([texts[0], texts[1] + KILL], tmp_path, STEPPED)
    found = [run_together(racks, [1.0, 1.0]) for _ in range(2)]
    assert digests(found[0]) == digests(found[1])
    other, struck = found[0]
    assert "rejoined" in struck.texts
    assert other.last[f"lan.{format_peer_port(names[1])}"]["losses"] == 0
    assert other.last["lan.status"]["import_other"]["missing"] == 0
    # It takes what was sent while it was away, of which the newest counts.
    assert struck.last["lan.status"]["import_other"]["missing"] == 0
    assert struck.last["lan.status"]["import_other"]["superseded"] > 0


def test_a_killed_rack_is_given_up_and_the_others_continue(
    names: list[str], tmp_path: Path
) -> None:
    texts = ring_texts(names[:2])
    texts[0] = texts[0].replace("lan_levels:Echo", "hasty_levels:Echo")
    racks = configs(texts, tmp_path, STEPPED)
    with running(racks[:1]) as (rack,), started(tmp_path / "rack-1.toml", None, STEPPED) as other:
        # Hold before the start: 300 ticks in lockstep take only milliseconds, so a hold that is set
        # while the rack runs may come too late for any later cycle to see the loss.
        rack.segment.words[System.HOLD_AT] = 200
        rack.start(1.0)
        other.await_event("start")
        watch([rack], until=lambda: rack.segment.words[System.HELD])
        assert rack.segment.words[System.HELD] == 200
        adapter = Segment.attach(names[1]).get_block("lan")[Block.PID]
        # Its boards die with the crate, and say nothing.
        os.kill(parent_of(adapter), signal.SIGKILL)
        wait_until(lambda: not runs(adapter))
        rack.segment.words[System.HOLD_AT] = 0
        watch([rack])
        assert ended(rack).outcome.cause == "time over"
        assert ended(rack).last[f"lan.{format_peer_port(names[1])}"]["presence"] == Presence.LOST


def test_a_rack_that_is_started_again_takes_no_part_and_says_why(
    names: list[str], tmp_path: Path
) -> None:
    racks = configs(ring_texts(names[:2]), tmp_path, STEPPED)
    with running(racks[:1]) as (rack,):
        # Hold before the start, or the run may be over before the other rack is started again.
        rack.segment.words[System.HOLD_AT] = 100
        rack.start(1.0)
        with started(tmp_path / "rack-1.toml", None, STEPPED) as other:
            other.await_event("start")
            watch([rack], until=lambda: rack.segment.words[System.HELD])
        with started(tmp_path / "rack-1.toml", None, STEPPED) as other:
            other.await_event("start")
            rack.segment.words[System.HOLD_AT] = 0
            assert other.outcome()["cause"] == "board lost"
            printed = [event["text"] for event in other.events if event["kind"] == "printed"]
            assert any(f"rack '{names[0]}' " in text for text in printed)
        watch([rack])
        assert ended(rack).outcome.cause == "time over"


def test_racks_wait_for_each_other_and_a_stop_ends_the_wait(
    names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(patience, "PATIENCE_S", 0.0)
    # In real time a clock hangs after this time. In lockstep it may wait for any time.
    monkeypatch.setattr(heartbeat, "LEAST_S", 0.05)
    racks = configs(ring_texts(names[:2]), tmp_path, STEPPED)
    with running(racks[:1]) as (rack,):
        rack.start(1.0)
        watch([rack], until=lambda: rack.segment.get_block("lan")[Block.AWAITS])
        reason = (
            f"waits for rack '{names[1]}': it has not connected yet,"
            " or its config does not name this rack"
        )
        assert [
            hold.why for hold in find_holds(NewestMessages(rack.segment)) if hold.level == "lan"
        ] == [reason]
        watch([rack], until=lambda: rack.events[-1].kind == "waiting")
        assert rack.segment.words[System.TICK] < CYCLE
        waited_s = time.monotonic() + 0.5
        watch([rack], until=lambda: time.monotonic() > waited_s)
        rack.stop("test")
        watch([rack])
        assert ended(rack).outcome.cause == "stopped"
        assert ended(rack).outcome.ticks <= CYCLE
        assert [event.text for event in rack.events if event.code == "hang"] == []


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ("adapter.lan.rate_hz=100", "cycles of adapter.lan differ: 10 ms in rack '{}', 20 ms in"),
        ("clock.mode=realtime", "rack '{}' runs in real time, this one in lockstep"),
    ],
)
def test_racks_of_different_clocks_say_so_and_end(
    names: list[str], tmp_path: Path, setting: str, text: str
) -> None:
    texts = ring_texts(names[:2])
    racks = [
        *configs(texts[:1], tmp_path, STEPPED),
        *configs(texts[1:], tmp_path, STEPPED, setting),
    ]
    with running(racks) as (one, other):
        one.start(1.0)
        other.start()
        # However long they take to connect.
        watch([one, other], until=lambda: one.outcome is not None)
        first = ended(one)
        other.stop("the test has seen enough")
        watch([other])
    assert first.outcome.cause == "board lost"
    assert text.format(names[1]) in first.texts
    assert "restart" not in first.texts
