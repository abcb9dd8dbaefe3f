"""The clocks of other racks: the estimator as pure arithmetic, and what is asked and answered."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rack.backplane.layout import Layout
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.lan import clocks
from rack.boards.lan.clocks import (
    _PING_KIND,
    _PONG,
    _PONG_KIND,
    ANSWER_NS,
    EAGER_NS,
    EAGER_ROUND_TRIPS,
    MAX_ASKERS,
    MAX_ROUND_TRIPS,
    MAX_UNANSWERED,
    PING_NS,
    ClockOffset,
    Clocks,
    PeerClock,
    RoundTrip,
)
from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import Envelope, Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.link import ReceivedMessage
from rack.boards.lan.peers import PeerRack, Peers
from rack.levels.peer import DRIFT_PPM
from rack.tools.network.certificates import make_credentials
from tests.boards.lan.conftest import MakeSegment

S, MS, US = 1_000_000_000, 1_000_000, 1_000
CLOCK_NS, PERIOD_NS = 2_500_000, 1_250_000
"""Twice as fast as time."""
LAUNCH, OTHER = 11, 22
AHEAD_NS = 1000 * S
"""How far the clock of the other machine is ahead."""

DELAYS = st.integers(1 * US, 2 * S)
PING = st.tuples(st.integers(0, 5 * S), DELAYS, st.integers(0, 1 * MS), DELAYS)


@given(
    offset=st.integers(-(10**18), 10**18),
    rate=st.integers(-DRIFT_PPM, DRIFT_PPM),
    pings=st.lists(PING, min_size=1),
)
def test_the_true_offset_is_always_within_the_uncertainty(
    offset: int, rate: int, pings: list[tuple[int, int, int, int]]
) -> None:
    def theirs(now: int) -> int:
        return now + offset + now * rate // 1_000_000

    found, now = ClockOffset(), 0
    for pause, there, answering, back in pings:
        sent = now + pause
        received, answered = sent + there, sent + there + answering
        now = answered + back
        assert found.add_round_trip(RoundTrip(sent, theirs(received), theirs(answered), now))
        assert found.steps == 0
        assert found.best is not None
        for later in (now, now + 7 * S):
            error_ns = abs(found.best.offset_ns - (theirs(later) - later))
            assert error_ns <= found.best.compute_uncertainty_ns(later)


def trip(at: int, offset: int, there: int = 200 * US, back: int = 200 * US) -> RoundTrip:
    return RoundTrip(at, at + there + offset, at + there + offset, at + there + back)


def test_the_shortest_recent_round_trip_counts_until_it_is_too_old() -> None:
    found = ClockOffset()
    best = trip(0, 5 * S, 20 * US, 20 * US)
    found.add_round_trip(best)
    found.add_round_trip(trip(1 * S, 5 * S))
    assert found.best == best
    for at in range(2, MAX_ROUND_TRIPS + 2):
        found.add_round_trip(trip(at * S, 5 * S))
    assert found.best is not None
    assert found.best.sent > S


@pytest.mark.parametrize("step", [3 * MS, -3 * MS, 10**12])
def test_a_clock_that_steps_begins_a_new_estimate(step: int) -> None:
    found = ClockOffset()
    for at in range(5):
        found.add_round_trip(trip(at * S, 0))
    found.add_round_trip(trip(5 * S, step))
    assert found.steps == 1
    assert len(found) == 1
    assert found.best is not None
    assert found.best.offset_ns == step


@pytest.mark.parametrize(
    "bad", [RoundTrip(100, 0, 500, 200), RoundTrip(200, 0, 0, 100), RoundTrip(100, 500, 400, 200)]
)
def test_an_impossible_round_trip_is_refused(bad: RoundTrip) -> None:
    found = ClockOffset()
    assert not found.add_round_trip(bad)
    assert found.best is None


def test_measurements_of_an_earlier_launch_are_discarded() -> None:
    peer = PeerRack("b")
    peer.add_token(7, 0)
    clock = PeerClock(peer)
    clock.discard_if_outdated()
    clock.epoch_ns, clock.period_ns, clock.clock_ns, clock.due_ns = 4 * S, 2 * MS, 5 * MS, 9
    clock.sent[1] = 2
    clock.discard_if_outdated()
    assert (clock.due_ns, clock.sent) == (9, {1: 2})
    peer.add_token(8, 1)
    clock.discard_if_outdated()
    assert (clock.epoch_ns, clock.clock_ns, clock.due_ns, clock.sent) == (0, 0, 0, {})


@pytest.fixture
def segment(make_segment: MakeSegment, rack_name: str) -> Segment:
    made = make_segment(Layout(rack_name, CLOCK_NS, (), ()))
    made.words[System.PERIOD_NS], made.words[System.EPOCH_NS] = PERIOD_NS, 100 * S
    return made


def test_a_message_never_counts_as_younger_than_it_is(segment: Segment) -> None:
    grid, peer = OwnGrid(segment, 1), PeerRack("b")
    head = Envelope(0, 0, 1, 1, 0, 0, stamp_ns=1100 * S + 10 * PERIOD_NS)
    peer.offset_ns, peer.uncertainty_ns = 1000 * S, 0
    assert grid.to_local_ns(head, peer) // CLOCK_NS == 10
    peer.uncertainty_ns = 3 * PERIOD_NS
    assert grid.to_local_ns(head, peer) // CLOCK_NS == 7


def test_the_mailbox_of_a_rack_has_its_clock_in_seconds(segment: Segment) -> None:
    peers = Peers(["b"])
    found = Clocks(segment, peers, 1, OwnGrid(segment, 1))
    found.write_clock(out := SimpleNamespace(), "b", 4)
    unknown = dict.fromkeys(("uncertainty", "round_trip"), -1.0)
    assert vars(out) == dict.fromkeys(("steps", "offset", "ahead", "speed"), 0.0) | unknown
    peers["b"].add_token(7, 0)
    clock = found._clocks["b"]
    clock.epoch_ns, clock.period_ns, clock.clock_ns = 1100 * S, 2 * MS, 5 * MS
    clock.offset.add_round_trip(trip(101 * S, 1000 * S, 300 * US, 100 * US))
    found._now_ns = 102 * S
    found.write_clock(out, "b", tick=800)
    # Of both ways' 0.4 ms the half, and what a clock drifts in a second.
    assert out.uncertainty == pytest.approx(200e-6 + DRIFT_PPM * 1e-6, rel=1e-5)
    assert (out.round_trip, out.speed, out.steps) == (400e-6, 2.5, 0)
    assert out.offset == pytest.approx(1000.0001, abs=1e-9)
    # Ours is at 2 s of simulated time, 1 s after its tick 0; theirs began at the same time.
    assert out.ahead == pytest.approx(2.5 * 1.0001 - 2.0, abs=1e-6)


class Wire:
    """Two racks' clocks with a network between them that keeps every message until the test passes
    it on."""

    def __init__(self, segment: Segment) -> None:
        self._rack, self._heard = segment.rack, dict[str, Any]()
        self.sent: list[ReceivedMessage] = []
        self.peers = Peers(["b"])
        self.clocks = Clocks(segment, self.peers, LAUNCH, OwnGrid(segment, 1))
        self.sealer = Sealer()
        self.clocks.open(self, self.sealer)  # type: ignore[arg-type]
        self.peers["b"].add_token(OTHER, 0)

    def call_on_arrival(self, key: str, callback: Any) -> None:
        self._heard[key] = callback

    def publish(self, key: str) -> Any:
        return lambda payload, envelope: self.sent.append(ReceivedMessage(key, envelope, payload))

    def answer(self, ping: ReceivedMessage, **more: Any) -> None:
        """Answer a ping, as rack `b` does at once, or otherwise."""
        head = self.sealer.open_message(ping.key, ping.envelope, ping.payload)
        assert isinstance(head, Envelope)
        now = time.monotonic_ns()
        told = {"launch": LAUNCH, "period": 1_000_000, "clock": CLOCK_NS, "kind": _PONG_KIND}
        told |= {"from": OTHER, "serial": head.serial, **more}
        theirs = now + AHEAD_NS
        payload = _PONG.pack(told["launch"], theirs, 50 * S, told["period"], told["clock"])
        key = f"rack/b/pong/{self._rack}"
        back = Envelope(told["kind"], told["from"], told["serial"], told["serial"], 0, 0, theirs)
        seal = self.sealer.seal(key, back, payload)
        pong = ReceivedMessage(key, seal, payload + more.get("more", b""))
        self._heard[f"rack/*/pong/{self._rack}"](pong)

    def take(self) -> tuple[int, int]:
        """Do a cycle; return the answers taken and refused so far."""
        self.clocks.exchange_pings()
        return self.clocks.taken, self.clocks.refused


@pytest.fixture
def wire(segment: Segment) -> Wire:
    return Wire(segment)


def ping(asker: str, sealer: Sealer, to: str) -> ReceivedMessage:
    key = f"rack/{asker}/ping/{to}"
    return ReceivedMessage(key, sealer.seal(key, Envelope(_PING_KIND, 1, 1, 1, 0, 0, 0), b""), b"")


def test_a_flood_of_pings_is_bounded_and_counted(wire: Wire, segment: Segment) -> None:
    responder, sealer = wire.clocks, wire.sealer
    began = time.monotonic_ns()
    for _ in range(1000):
        responder._answer_ping(ping("flood", sealer, segment.rack))
    most = 1 + (time.monotonic_ns() - began) // ANSWER_NS
    assert 1 <= len(wire.sent) == responder.answered <= most
    assert responder.withheld == 1000 - responder.answered
    # An answer says when the ping came, when it went itself, and on which grid this rack is.
    key, envelope, payload = wire.sent[0]
    launch, received, *grid = _PONG.unpack(payload)
    head = sealer.open_message(key, envelope, payload)
    assert isinstance(head, Envelope)
    assert (launch, grid) == (1, [100 * S, PERIOD_NS, CLOCK_NS])
    assert began <= received <= head.stamp_ns
    # One rack's flood takes nothing from another; but of racks, too, there are not endlessly many.
    for at in range(MAX_ASKERS):
        responder._answer_ping(ping(f"rack-{at}", sealer, segment.rack))
    keys = {answer.key for answer in wire.sent}
    assert len(keys) == MAX_ASKERS
    assert f"rack/{segment.rack}/pong/rack-0" in keys


def test_a_ping_with_a_seal_of_another_rack_gets_no_answer(
    wire: Wire, segment: Segment, tmp_path: Path
) -> None:
    make_credentials(tmp_path, {segment.rack: [], "asker": [], "stranger": []}, 1)
    own, asker, stranger = (
        Sealer(Credentials(tmp_path, name)) for name in (segment.rack, "asker", "stranger")
    )
    responder = wire.clocks
    responder.open(wire, own)  # type: ignore[arg-type]
    responder._answer_ping(ping("asker", stranger, segment.rack))
    assert wire.sent == []
    assert (responder.answered, responder.refused) == (0, 1)
    responder._answer_ping(ping("asker", asker, segment.rack))
    assert (responder.answered, responder.refused) == (1, 1)


def test_a_rack_is_pinged_often_until_its_clock_is_known(
    wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [time.monotonic_ns()]
    monkeypatch.setattr(clocks, "monotonic_ns", lambda: now[0])
    clock = wire.clocks._clocks["b"]
    for trips in range(EAGER_ROUND_TRIPS + 2):
        wire.take()
        assert len(wire.sent) == trips + 1
        pause = PING_NS if trips >= EAGER_ROUND_TRIPS else EAGER_NS
        assert clock.due_ns == now[0] + pause
        monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])
        wire.answer(wire.sent[-1])
        now[0] += pause - 1
        wire.take()
        assert (len(wire.sent), len(clock.offset)) == (trips + 1, trips + 1)
        now[0] += 1


def test_an_answer_is_taken_once_and_gives_offset_and_grid(wire: Wire) -> None:
    peer = wire.peers["b"]
    assert wire.take() == (0, 0)
    assert (peer.offset_ns, peer.uncertainty_ns) == (None, 0)
    wire.answer(wire.sent[0])
    wire.answer(wire.sent[0])
    assert wire.take() == (1, 1)
    clock = wire.clocks._clocks["b"]
    assert (clock.epoch_ns, clock.period_ns, clock.clock_ns) == (50 * S, 1_000_000, CLOCK_NS)
    assert peer.offset_ns is not None
    assert abs(peer.offset_ns - AHEAD_NS) <= peer.uncertainty_ns < S


@pytest.mark.parametrize(
    "wrong",
    [
        {"launch": LAUNCH + 1},
        {"from": OTHER + 1},
        {"period": 0},
        {"clock": 0},
        {"serial": 5},
        {"kind": _PING_KIND},
        {"more": b"x"},
    ],
)
def test_an_unexpected_answer_is_refused(wire: Wire, wrong: dict[str, Any]) -> None:
    wire.take()
    wire.answer(wire.sent[0], **wrong)
    assert wire.take() == (0, 1)
    wire.answer(wire.sent[0])
    assert wire.take() == (1, 1)


def test_an_absent_rack_is_not_pinged(wire: Wire) -> None:
    wire.peers["b"].remove_token(OTHER, 1)
    wire.take()
    assert wire.sent == []


def test_only_the_newest_unanswered_pings_are_remembered(
    wire: Wire, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = wire.clocks._clocks["b"]
    for _ in range(MAX_UNANSWERED + 3):
        clock.due_ns = 0
        wire.take()
    assert len(clock.sent) == MAX_UNANSWERED
    assert min(clock.sent) == max(clock.sent) - MAX_UNANSWERED + 1
