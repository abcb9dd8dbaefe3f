"""What the barrier passes on of a step: no more than its sender may export, and nothing twice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from rack.backplane.segment import Segment, unlink
from rack.backplane.words import Block
from rack.boards.config.resolved import loads, wire
from rack.boards.lan.envelope import Envelope, Sealer
from rack.boards.lan.keys import out_key, step_key
from rack.boards.lan.link import Arrived
from rack.boards.lan.lockstep import STEP_KIND, Barrier, pack_step
from tests.boards.lan.conftest import EVERY, LAUNCH
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
        exports = [Arrived(key, b"", f"{rack} {cycle}".encode()) for key in keys]
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
def segment(rack_name: str) -> Iterator[Segment]:
    """The segment of a rack that steps with two others."""
    config = loads(rack_text(rack_name, "", [], "two", peers=OTHERS))
    made = Segment.create(wire(config), config.text())
    yield made
    made.close()
    unlink(rack_name)


def opened(segment: Segment) -> tuple[Barrier, Session]:
    barrier, session = Barrier(segment, "lan", OTHERS, ()), Session(segment.rack)
    barrier.open(session, LAUNCH)  # type: ignore[arg-type]
    return barrier, session


def test_a_rack_exports_nothing_for_another(segment: Segment) -> None:
    barrier, session = opened(segment)
    arrived = {rack: barrier.subscribe(key) for rack, key in KEYS.items()}
    session.bring("two", 0, *KEYS.values())
    session.bring("three", 0, KEYS["three"])
    assert barrier.meet(0)
    assert {rack: [one.payload for one in take()] for rack, take in arrived.items()} == {
        "two": [b"two 0"],
        "three": [b"three 0"],
    }


def test_what_was_passed_on_before_a_restart_is_not_passed_on_again(segment: Segment) -> None:
    segment.block("lan")[Block.DONE] = 2 * EVERY
    barrier, session = opened(segment)
    take = barrier.subscribe(KEYS["two"])
    for cycle in (2, 3):
        for rack in OTHERS:
            session.bring(rack, cycle, KEYS[rack])
    assert barrier.meet(3 * EVERY)
    assert [one.payload for one in take()] == [b"two 3"]
