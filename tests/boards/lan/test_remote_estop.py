"""The desk of a network adapter: which requests set the emergency stop, and which do not."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.words import System
from rack.boards.config import load, resolve_layout
from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import Envelope, Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import estop_answer_key, estop_key
from rack.boards.lan.link import Question, ReceivedMessage
from rack.boards.lan.remote_estop import CHECK_FLAG, ESTOP_KIND, EstopResponder
from rack.levels.level import Finding
from rack.tools.network.certificates import make_credentials
from tests.boards.commanded_racks import COMMANDED

LAUNCH, SESSION = 77, 5
ASKERS = {"operator": 1, "second": 2}


class Line:
    """A link whose requests a test sends; answers are opened as an operator does."""

    def __init__(self, rack: str) -> None:
        self.rack, self.sealer = rack, Sealer()
        self.most = 0
        self.answers: list[Envelope] = []
        self._waiting: list[Question] = []
        self._number = 0

    def open_questions(self, key: str, unread: int) -> Callable[[], Iterator[Question]]:
        assert key == estop_key("*", self.rack)
        self.most = unread

        def take() -> Iterator[Question]:
            found, self._waiting = self._waiting, []
            yield from found

        return take

    def ask(
        self,
        asker: str = "operator",
        *,
        flags: int = 0,
        kind: int = ESTOP_KIND,
        payload: bytes = b"",
        sealed_for: str = "",
    ) -> None:
        """Send a request, by default a proper one."""
        self._number += 1
        key = estop_key(asker, self.rack)
        head = Envelope(kind, SESSION, self._number, 0, 0, 0, 0, flags)
        self.put(asker, self.sealer.seal(sealed_for or key, head, payload), payload)

    def put(self, asker: str, envelope: bytes | None, payload: bytes = b"") -> None:

        def reply(payload: bytes, attachment: bytes) -> None:
            key = estop_answer_key(self.rack, asker)
            head = self.sealer.open_message(key, attachment, payload)
            assert isinstance(head, Envelope)
            assert payload == b""
            self.answers.append(head)

        self._waiting.append(
            Question(ReceivedMessage(estop_key(asker, self.rack), envelope, payload), reply)
        )


class Bench:
    """A desk at the segment of a rack that is not running."""

    def __init__(self, segment: Segment) -> None:
        self.segment, self.findings, self.tick = segment, list[Finding](), 40
        self.desk = EstopResponder(segment, OwnGrid(segment, 8), ASKERS, self.findings)
        self.line = Line(segment.rack)
        self.open()

    def open(self) -> None:
        """Let the desk take requests from the line."""
        self.desk.open(self.line, LAUNCH)  # type: ignore[arg-type]

    def cycle(self) -> list[Envelope]:
        """Let the desk have a cycle; return its answers."""
        self.tick += 8
        self.line.answers.clear()
        self.desk.answer_requests(self.tick)
        return list(self.line.answers)

    @property
    def is_stopped(self) -> bool:
        return bool(self.segment.words[System.EMERGENCY_STOP])

    @property
    def counts(self) -> tuple[int, ...]:
        return self.desk.count.record.item()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    name = f"test-desk-{os.getpid()}"
    path = tmp_path / "rack.toml"
    path.write_text(COMMANDED)
    segment = Segment.create(
        resolve_layout(load(path, [f"name={name}", "clock.mode=realtime"])), ""
    )
    try:
        # A rack's clock has set these before the first cycle of a board.
        segment.words[System.PERIOD_NS] = 2_500_000
        yield Bench(segment)
    finally:
        segment.close()
        unlink_segment(name)


def test_a_stop_is_set_reported_once_and_answered_for_its_request_and_launch(
    bench: Bench,
) -> None:
    for asker in ("second", "operator"):
        bench.line.ask(asker)
    answers = bench.cycle()
    assert [(head.number, head.serial, head.launch, head.tick) for head in answers] == [
        (SESSION, 1, LAUNCH, bench.tick),
        (SESSION, 2, LAUNCH, bench.tick),
    ]
    assert bench.is_stopped
    assert [(finding.alarm.name, finding.subject) for finding in bench.findings] == [
        ("REMOTE_STOP", 2)
    ]
    assert bench.counts == (2, 0, 0)


def test_a_check_is_answered_and_sets_nothing(bench: Bench) -> None:
    bench.line.ask(flags=CHECK_FLAG)
    assert len(bench.cycle()) == 1
    assert not bench.is_stopped
    assert not bench.findings


def test_forbidden_malformed_and_unsigned_requests_get_no_answer(bench: Bench) -> None:
    line = bench.line
    line.ask("nobody")
    line.ask(payload=b"x")
    line.ask(kind=ESTOP_KIND + 1)
    line.ask(sealed_for=estop_key("second", line.rack))
    line.ask(sealed_for=estop_answer_key(line.rack, "operator"))
    line.put("operator", None)
    line.put("operator", b"RLN1")
    assert bench.cycle() == []
    assert not bench.is_stopped
    assert bench.counts == (0, 1, 6)


def test_nobody_can_request_a_stop_under_another_name(bench: Bench, tmp_path: Path) -> None:
    names = (bench.segment.rack, *ASKERS)
    make_credentials(tmp_path, dict.fromkeys(names, ()), 1)
    rack, operator, second = (Sealer(Credentials(tmp_path, name)) for name in names)
    bench.line.sealer = rack
    bench.open()
    bench.line.sealer = second
    bench.line.ask("operator")
    assert bench.cycle() == []
    assert (bench.is_stopped, bench.counts) == (False, (0, 0, 1))
    bench.line.sealer = operator
    bench.line.ask("operator")
    # The answer has the seal of the rack, which `Line` checks.
    assert len(bench.cycle()) == 1
    assert bench.is_stopped


def test_counters_continue_after_a_restart_and_are_empty_in_lockstep(
    bench: Bench,
) -> None:
    group = np.zeros((), [("answered", "u4"), ("refused", "u4"), ("dropped", "u4")])
    bench.line.ask()
    bench.line.ask("nobody")
    bench.cycle()
    bench.desk.write_counts(group)
    assert group.tolist() == (1, 1, 0)
    group["dropped"] = 7
    for is_lockstep, expected in ((0, (1, 1, 7)), (1, (0, 0, 0))):
        bench.segment.words[System.LOCKSTEP] = is_lockstep
        successor = EstopResponder(bench.segment, OwnGrid(bench.segment, 8), ASKERS, [])
        successor.restore_counts(group)
        shown = np.zeros_like(group)
        successor.write_counts(shown)
        assert shown.tolist() == expected
