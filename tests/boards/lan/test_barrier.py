"""The barrier of racks in lockstep: what it passes on of a step, how long it awaits a partner, and
how a step is packed."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.boards.config.loader import load_text
from rack.boards.config.resolved import resolve_layout
from rack.boards.lan.awaited import WaitReason, encode_wait
from rack.boards.lan.envelope import Envelope, Sealer
from rack.boards.lan.keys import out_key, step_key
from rack.boards.lan.link import ReceivedMessage
from rack.boards.lan.lockstep import (
    NEVER,
    STEP_KIND,
    Barrier,
    Partner,
    Step,
    StepFlag,
    pack_step,
    unpack_step,
)
from rack.boards.lan.peers import NO_LAUNCH
from tests.boards.lan.conftest import EVERY, LAUNCH, MakeSegment
from tests.boards.lan.racks import rack_text

OTHERS = ("two", "three")
CYCLE_NS = EVERY * 2_500_000
KEYS = {rack: out_key(rack, "pulse.status") for rack in OTHERS}


class Session:
    """Stands in for the network: what tests `bring` is taken in the next cycle."""

    def __init__(self, rack: str) -> None:
        self.rack = rack
        self.sealer = Sealer()
        self.session = self
        self._take: Callable[[Any], None]

    def liveliness(self) -> Session:
        return self

    def declare_subscriber(self, key: str, handler: Any, history: bool = False) -> None:
        self._take = handler.callback

    def publish(self, key: str, reliable: bool = False) -> Callable[[bytes, bytes], None]:
        return lambda payload, envelope: None

    def bring(self, rack: str, cycle: int, *keys: str) -> None:
        """Bring the step of a rack's cycle, with an export under each key."""
        exports = [ReceivedMessage(key, b"", f"{rack} {cycle}".encode()) for key in keys]
        content = pack_step(CYCLE_NS, [self.rack], exports)
        head = Envelope(STEP_KIND, LAUNCH, cycle + 1, cycle + 1, cycle, cycle * CYCLE_NS, 0)
        envelope = self.sealer.seal(step_key(rack), head, content)
        self._take(
            SimpleNamespace(
                key_expr=step_key(rack),
                attachment=SimpleNamespace(to_bytes=lambda: envelope),
                payload=SimpleNamespace(to_bytes=lambda: content),
            )
        )


@pytest.fixture
def segment(make_segment: MakeSegment, rack_name: str) -> Segment:
    """The segment of a rack that steps with two others."""
    config = load_text(rack_text(rack_name, "", [], "two", peers=OTHERS))
    return make_segment(resolve_layout(config), config.to_toml_text())


def opened(segment: Segment) -> tuple[Barrier, Session]:
    barrier, session = Barrier(segment, "lan", OTHERS, ()), Session(segment.rack)
    barrier.open(session, LAUNCH)  # type: ignore[arg-type]
    return barrier, session


def test_a_rack_exports_nothing_for_another(segment: Segment) -> None:
    barrier, session = opened(segment)
    arrived = {rack: barrier.subscribe(key) for rack, key in KEYS.items()}
    session.bring("two", 0, *KEYS.values())
    session.bring("three", 0, KEYS["three"])
    assert barrier.exchange_steps(0)
    for rack, take in arrived.items():
        assert [one.payload for one in take()] == [f"{rack} 0".encode()]


def test_exports_delivered_before_a_restart_are_not_delivered_again(segment: Segment) -> None:
    segment.get_block("lan")[Block.DONE] = 2 * EVERY
    barrier, session = opened(segment)
    take = barrier.subscribe(KEYS["two"])
    for cycle in (2, 3):
        for rack in OTHERS:
            session.bring(rack, cycle, KEYS[rack])
    assert barrier.exchange_steps(3 * EVERY)
    assert [one.payload for one in take()] == [b"two 3"]


def step(time_ns: int, flags: int = 0) -> Step:
    return Step(HEAD._replace(launch=7, time_ns=time_ns, flags=flags), 8, ["a"], [])


def test_steps_are_kept_once_and_in_order() -> None:
    partner = Partner("b", 3)
    for time_ns in (8, 16, 16, 8, 24):
        partner.add_step(step(time_ns))
    assert [kept.head.time_ns for kept in partner.steps] == [8, 16, 24]
    assert partner.time_ns == 24


def test_a_rack_that_has_ended_is_not_awaited_until_it_sends_again() -> None:
    partner = Partner("b", 3)
    partner.gone_s = 1.0
    partner.add_step(step(8, StepFlag.OVER))
    assert (partner.is_out, partner.gone_s) == (True, None)
    partner.add_step(step(16))
    assert not partner.is_out


def test_the_word_says_why_it_is_awaited() -> None:
    partner = Partner("b", 3)
    assert partner.wait_word == encode_wait(3, WaitReason.UNSEEN)
    partner.launch = 7
    assert partner.wait_word == encode_wait(3, WaitReason.SLOWER)
    partner.gone_s = 1.0
    assert partner.wait_word == encode_wait(3, WaitReason.GONE)


def test_a_partner_that_is_reset_is_awaited_as_at_first() -> None:
    partner = Partner("b", 3)
    partner.launch = 7
    partner.gone_s = 1.0
    partner.is_present = True
    partner.add_step(step(8, StepFlag.OVER))
    partner.reset_state()
    assert (partner.launch, partner.time_ns, partner.gone_s) == (NO_LAUNCH, NEVER, None)
    assert not partner.steps
    assert [partner.is_out, partner.is_present] == [False] * 2


HEAD = Envelope(STEP_KIND, 11, 1, 1, 40, 100_000_000, 0, StepFlag.OVER)
EXPORTS = (
    ReceivedMessage("a/first", b"head of one", b"payload"),
    ReceivedMessage("b", b"", b""),
    ReceivedMessage("c/third", b"h", b"x" * 300),
    ReceivedMessage("d", None, b"payload"),
)


@pytest.mark.parametrize("count", range(5))
def test_a_step_arrives_as_it_was_sent(count: int) -> None:
    content = pack_step(5_000_000, ("puma", "k1607"), EXPORTS[:count])
    # One without an envelope arrives with an empty one.
    exports = [one._replace(envelope=one.envelope or b"") for one in EXPORTS[:count]]
    expected = Step(HEAD, 5_000_000, ["puma", "k1607"], exports)
    assert unpack_step(HEAD, content) == expected


def test_truncated_extended_or_foreign_content_is_not_a_step() -> None:
    content = pack_step(5_000_000, ("puma",), EXPORTS)
    assert not any(unpack_step(HEAD, content[:length]) for length in range(len(content)))
    assert unpack_step(HEAD, content + b"x") is None
    assert unpack_step(HEAD._replace(kind=STEP_KIND + 1), content) is None
    # No text: a key of bytes that are no UTF-8.
    assert unpack_step(HEAD, content.replace(b"a/first", b"\xff/first")) is None
