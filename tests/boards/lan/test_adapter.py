"""A network adapter on a backplane without processes: what it demands and says of the other
racks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest

from rack.backplane.message import State
from rack.backplane.segment import Segment
from rack.backplane.words import System, is_switched_on
from rack.boards.config import resolve
from rack.boards.lan.adapter import LanAdapter
from rack.boards.lan.clocks import REPORT_UNKNOWN_NS
from rack.boards.lan.envelope import Flaw, Sealer
from rack.boards.lan.status import build_status_class
from rack.levels.peer import PeerPresence
from rack.levels.references import find_class
from tests.boards.config.mistakes import read_config
from tests.boards.lan.conftest import EVERY, MakeSegment
from tests.boards.lan.racks import rack_text

PERIOD_NS = 2_500_000
STOP = 'on_peer_loss = "stop"'
FIRST, SECOND = 7, 8
"""Launches of the other rack."""

MakeAdapter = Callable[..., tuple[LanAdapter, Segment]]
Change = tuple[str, int, bool]


@pytest.fixture
def make(make_segment: MakeSegment, rack_name: str) -> MakeAdapter:
    """Make the one adapter of a test: what comes and goes is what its list has."""

    def make_one(
        changes: list[Change], lan: str = "", *, lockstep: bool = False
    ) -> tuple[LanAdapter, Segment]:
        text = rack_text(rack_name, "tcp/127.0.0.1:7447", (), "b", peers=("b",), lan=lan)
        mode = "lockstep" if lockstep else "realtime"
        plan = resolve(read_config(text, [f"clock.mode={mode}"]))
        segment = make_segment(plan.layout, lockstep=lockstep)
        (wiring,) = (task for task in plan.tasks if task.task == "lan")
        adapter = find_class(wiring.target, LanAdapter)(wiring.context)
        adapter.attach_segment(segment, None)

        def taken() -> Iterator[Change]:
            while changes:
                yield changes.pop(0)

        adapter._peers.set_source(taken, lockstep)
        return adapter, segment

    return make_one


def test_a_lost_rack_stops_the_arm_until_it_is_back(make: MakeAdapter) -> None:
    changes: list[Change] = []
    adapter, segment = make(changes, STOP)
    stop = segment.words[System.PEER_STOP]

    def look(tick: int, *seen: Change) -> int:
        changes.extend(seen)
        adapter._update_presence(tick)
        return segment.words[System.PEER_STOP]

    # One that has not come yet is not lost.
    assert look(8) == stop == 0
    assert look(16, ("b", FIRST, True)) == 0
    lost = look(24, ("b", FIRST, False))
    assert [is_switched_on(lost, tick) for tick in (23, 24)] == [False, True]
    assert look(32) == lost
    back = look(40, ("b", FIRST, True))
    assert [is_switched_on(back, tick) for tick in (39, 40)] == [True, False]


def test_in_lockstep_a_demand_counts_from_the_next_cycle(make: MakeAdapter) -> None:
    changes: list[Change] = [("b", FIRST, True)]
    adapter, segment = make(changes, STOP, lockstep=True)
    adapter._update_presence(8)
    changes.append(("b", FIRST, False))
    adapter._update_presence(16)
    word = segment.words[System.PEER_STOP]
    assert [is_switched_on(word, tick) for tick in (16 + EVERY - 1, 16 + EVERY)] == [False, True]


def test_a_lost_rack_does_not_stop_the_arm_if_the_config_says_go_on(make: MakeAdapter) -> None:
    changes: list[Change] = [("b", FIRST, True), ("b", FIRST, False)]
    adapter, segment = make(changes, 'on_peer_loss = "go on"')
    adapter._update_presence(8)
    assert adapter._peers.lost_racks == ["b"]
    assert segment.words[System.PEER_STOP] == 0


def test_a_rack_that_joins_is_sent_every_newest_message(make: MakeAdapter) -> None:
    changes: list[Change] = []
    adapter, _ = make(changes)
    (export,) = adapter._exports.values()
    export.must_resend = False
    adapter._update_presence(8)
    assert not export.must_resend
    changes.append(("stranger", FIRST, True))
    adapter._update_presence(16)
    assert export.must_resend


def test_the_status_says_why_the_exchange_is_incomplete(make: MakeAdapter) -> None:
    changes: list[Change] = []
    adapter, _ = make(changes)

    def said(tick: int, *seen: Change) -> str:
        changes.extend(seen)
        adapter._update_presence(tick)
        return adapter._find_trouble(tick)

    assert said(0) == "rack 'b' is not there yet"
    assert said(8, ("b", FIRST, True)) == ""
    unknown = 8 + REPORT_UNKNOWN_NS // PERIOD_NS
    assert said(unknown) == ""
    assert said(unknown + 1) == "clock of rack 'b' is not known: it does not answer pings"
    adapter._peers["b"].offset_ns = 0
    assert said(unknown + 1) == ""
    assert said(unknown + 1, ("b", SECOND, True)) == "2 racks are named 'b'"
    assert said(unknown + 1, ("b", FIRST, False)) == ""
    assert said(unknown + 1, ("b", SECOND, False)) == "rack 'b' is lost"
    assert said(unknown + 1, ("b", SECOND, True)) == ""
    (entry,) = adapter._imports.values()
    entry._basis = unknown
    # Permitted are 100 ms.
    assert said(unknown + 40) == ""
    assert said(unknown + 41) == "'b/pulse.status' is older than max_age_ms"


def test_in_real_time_the_status_counts_messages_with_flaws(make: MakeAdapter) -> None:
    adapter, _ = make([])
    # What is imported needs a link to be counted.
    adapter._imports.clear()
    sealer = Sealer()
    sealer.flaws = dict.fromkeys(Flaw, 3)
    out = build_status_class(adapter._table.exports, adapter._table.imports).zeros({})
    adapter.store_output("status", out)
    adapter.store_output("peer_b", PeerPresence.zeros({}))
    adapter._write_status(8)
    assert out.flaws.tolist() == (0,) * len(Flaw)
    assert (out.state, out.reason) == (State.HOLDING, "rack 'b' is not there yet")
    adapter._link = SimpleNamespace(sealer=sealer)  # type: ignore[assignment]
    adapter._write_status(8)
    assert out.flaws.tolist() == (3,) * len(Flaw)
