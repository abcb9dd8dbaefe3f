"""The desk of a network adapter: which requests set the emergency stop, and which do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config import resolve_layout
from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import Envelope, Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import estop_answer_key, estop_key
from rack.boards.lan.link import Question, ReceivedMessage
from rack.boards.lan.remote_estop import CHECK_FLAG, ESTOP_KIND, EstopResponder
from rack.levels.level import Finding
from rack.tools.network.certificates import make_credentials
from tests.boards.commanded_racks import COMMANDED
from tests.boards.config.mistakes import read_config
from tests.boards.lan.conftest import MakeSegment

LAUNCH, SESSION = 77, 5
ASKERS = {"operator": 1, "second": 2}


class Bench:
    """A desk at the segment of a rack that is not running, and its link: tests send requests, and
    answers are opened as an operator does."""

    def __init__(self, segment: Segment) -> None:
        self.segment, self.rack, self.tick = segment, segment.rack, 40
        self.findings: list[Finding] = []
        self.desk = EstopResponder(segment, OwnGrid(segment, 8), ASKERS, self.findings)
        self.sealer = Sealer()
        self._answers: list[Envelope] = []
        self._waiting: list[Question] = []
        self._number = 0
        self.open()

    def open(self) -> None:
        self.desk.open(self, LAUNCH)  # type: ignore[arg-type]

    def open_questions(self, key: str, unread: int) -> Callable[[], Iterator[Question]]:
        assert key == estop_key("*", self.rack)

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
        key = sealed_for or estop_key(asker, self.rack)
        head = Envelope(kind, SESSION, self._number, 0, 0, 0, 0, flags)
        self.put(asker, self.sealer.seal(key, head, payload), payload)

    def put(self, asker: str, envelope: bytes | None, payload: bytes = b"") -> None:

        def reply(payload: bytes, attachment: bytes) -> None:
            key = estop_answer_key(self.rack, asker)
            head = self.sealer.open_message(key, attachment, payload)
            assert isinstance(head, Envelope)
            assert payload == b""
            self._answers.append(head)

        message = ReceivedMessage(estop_key(asker, self.rack), envelope, payload)
        self._waiting.append(Question(message, reply))

    def cycle(self) -> list[Envelope]:
        """Let the desk have a cycle; return its answers."""
        self.tick += 8
        self._answers = []
        self.desk.answer_requests(self.tick)
        return self._answers

    @property
    def is_stopped(self) -> bool:
        return bool(self.segment.words[System.EMERGENCY_STOP])

    @property
    def counts(self) -> tuple[int, ...]:
        return self.desk.count.record.item()


@pytest.fixture
def bench(make_segment: MakeSegment, rack_name: str) -> Bench:
    config = read_config(COMMANDED, [f"name={rack_name}", "clock.mode=realtime"])
    return Bench(make_segment(resolve_layout(config)))


def test_a_stop_is_set_reported_once_and_answered_for_its_request_and_launch(bench: Bench) -> None:
    for asker in ("second", "operator"):
        bench.ask(asker)
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
    bench.ask(flags=CHECK_FLAG)
    assert len(bench.cycle()) == 1
    assert not bench.is_stopped
    assert not bench.findings


def test_forbidden_malformed_and_unsigned_requests_get_no_answer(bench: Bench) -> None:
    bench.ask("nobody")
    bench.ask(payload=b"x")
    bench.ask(kind=ESTOP_KIND + 1)
    bench.ask(sealed_for=estop_key("second", bench.rack))
    bench.ask(sealed_for=estop_answer_key(bench.rack, "operator"))
    bench.put("operator", None)
    bench.put("operator", b"RLN1")
    assert bench.cycle() == []
    assert not bench.is_stopped
    assert bench.counts == (0, 1, 6)


def test_nobody_can_request_a_stop_under_another_name(bench: Bench, tmp_path: Path) -> None:
    names = (bench.segment.rack, *ASKERS)
    make_credentials(tmp_path, dict.fromkeys(names, ()), 1)
    rack, operator, second = (Sealer(Credentials(tmp_path, name)) for name in names)
    bench.sealer = rack
    bench.open()
    bench.sealer = second
    bench.ask("operator")
    assert bench.cycle() == []
    assert (bench.is_stopped, bench.counts) == (False, (0, 0, 1))
    bench.sealer = operator
    bench.ask("operator")
    # The answer has the seal of the rack, which `Bench` checks.
    assert len(bench.cycle()) == 1
    assert bench.is_stopped


def test_counters_continue_after_a_restart_and_are_empty_in_lockstep(bench: Bench) -> None:
    group = np.zeros((), [("answered", "u4"), ("refused", "u4"), ("dropped", "u4")])
    bench.ask()
    bench.ask("nobody")
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
