"""The desk of a network adapter: what it answers, refuses and drops, and how much of it in a
cycle."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rack.backplane.mailbox.slots import message_dtype
from rack.backplane.message import Message
from rack.backplane.operator_table import OperatorTable, Request, RequestStage, RequestWord
from rack.backplane.segment import VERSION, Segment, unlink
from rack.backplane.words import Head, System
from rack.boards.config import load, wire
from rack.boards.lan import desk as desks
from rack.boards.lan.credentials import Credentials
from rack.boards.lan.desk import ANSWERS_A_CYCLE, BYTES_A_CYCLE, QUESTIONS_A_CYCLE, Desk, Permit
from rack.boards.lan.envelope import Envelope, Sealer
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.link import Question
from rack.boards.lan.questions import (
    MOST_CONTENT,
    MOST_QUESTION,
    Code,
    DeskAnswer,
    Stretch,
    Ticket,
    answer_key,
    packed_request,
    packed_stretches,
    question_key,
)
from rack.levels.level import Finding
from rack.levels.operator import Operation
from rack.tools.network.certificates import make_credentials
from tests.boards.commanded_racks import COMMANDED

RIGHTS = {"operator": ("watch", "command", "stop"), "watcher": ("watch",)}
LAUNCH, SESSION = 77, 5
HEAD = packed_stretches([Stretch(0, 80)])


class Got(NamedTuple):
    """An answer, with its envelope."""

    head: Envelope
    answer: DeskAnswer


class Line:
    """A link whose questions a test asks; answers are opened as a client does."""

    def __init__(self, rack: str) -> None:
        self.rack, self.sealer = rack, Sealer()
        self.waiting: dict[str, list[Question]] = {}
        self.answers: list[Got] = []
        self._number = 0

    def answer(self, key: str) -> Callable[[], Iterator[Question]]:
        """Return a function that takes what waits under a key with two wildcards at its end."""
        place = key.removesuffix("/*/*")
        queue = self.waiting.setdefault(place, [])

        def take() -> Iterator[Question]:
            while queue:
                yield queue.pop(0)

        return take

    def ask(
        self,
        what: str,
        payload: bytes = b"",
        asker: str = "operator",
        version: int = VERSION,
        again: int = 0,
    ) -> None:
        """Ask a proper question, `again` the one of that number."""
        self._number += 1
        key = question_key(self.rack, what, asker)  # type: ignore[arg-type]
        head = Envelope(version, SESSION, self._number, again or self._number, 0, 0, 0)
        self.put(Question(key, self.sealer.seal(key, head, payload), payload, self._opener(key)))

    def put(self, question: Question) -> None:
        """Ask anything."""
        self.waiting["/".join(question.key.split("/")[:4])].append(question)

    def _opener(self, key: str) -> Callable[[bytes, bytes], None]:
        def reply(payload: bytes, envelope: bytes) -> None:
            head, answer = (
                self.sealer.opened(answer_key(key), envelope, payload),
                DeskAnswer.unpacked(payload),
            )
            assert isinstance(head, Envelope)
            assert answer is not None
            self.answers.append(Got(head, answer))

        return reply


class Bench:
    """A desk at the segment of a rack that is not running."""

    def __init__(self, segment: Segment) -> None:
        self.segment, self.findings, self.tick = segment, list[Finding](), 40
        self.desk = Desk(
            segment, OwnGrid(segment, 8), Permit(RIGHTS, ("other", *RIGHTS)), self.findings
        )  # type: ignore[arg-type]
        self.line = Line(segment.rack)
        self.desk.open(self.line, LAUNCH)  # type: ignore[arg-type]
        self.cycle()

    def cycle(self) -> list[Got]:
        """Let the desk have a cycle; return its answers."""
        self.tick += 8
        self.line.answers.clear()
        self.desk.answer(self.tick)
        return list(self.line.answers)

    def asked(self, what: str, payload: bytes = b"", asker: str = "operator") -> DeskAnswer:
        """Ask one question, and return its answer."""
        self.line.ask(what, payload, asker)
        (got,) = self.cycle()
        return got.answer

    def command(self, what: Operation = Operation.HOLD, tick: int = -1) -> Request:
        """Return a request to level upper."""
        boxes = self.segment.layout.mailboxes
        at = next(at for at, box in enumerate(boxes) if box.name == "upper.operator")
        message = Message(message_dtype(boxes[at].fields, boxes[at].size))
        message.what = what
        return Request(at, bytes(message.raw), tick)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    name = f"test-desk-{os.getpid()}"
    path = tmp_path / "rack.toml"
    path.write_text(COMMANDED)
    segment = Segment.create(wire(load(path, [f"name={name}", "clock.mode=realtime"])), "")
    try:
        # A rack's clock has set these before the first cycle of a board.
        segment.words[System.PERIOD_NS] = 2_500_000
        yield Bench(segment)
    finally:
        segment.close()
        unlink(name)


def test_stretches_of_the_segment_are_answered_in_their_order(bench: Bench) -> None:
    wanted = [Stretch(8 * Head.SIZE, 8), Stretch(0, 16), Stretch(len(bench.segment.bytes) - 4, 4)]
    answer = bench.asked("read", packed_stretches(wanted))
    assert answer.code is Code.GRANTED
    assert answer.content == b"".join(bytes(bench.segment.view(*stretch)) for stretch in wanted)
    assert (bench.desk.count.answered, bench.desk.count.refused, bench.desk.count.dropped) == (
        1,
        0,
        0,
    )


def test_an_answer_belongs_to_its_question_and_to_this_launch(bench: Bench) -> None:
    for _ in range(2):
        bench.line.ask("read", HEAD)
    heads = [got.head for got in bench.cycle()]
    assert [(head.number, head.serial, head.launch, head.tick) for head in heads] == [
        (SESSION, 1, LAUNCH, bench.tick),
        (SESSION, 2, LAUNCH, bench.tick),
    ]


@pytest.mark.parametrize(
    "stretch",
    [Stretch(1 << 40, 8), Stretch((1 << 64) - 8, 16), Stretch(0, MOST_CONTENT + 1)],
    ids=["far", "wrap", "big"],
)
def test_what_is_outside_the_segment_or_too_much_is_refused(bench: Bench, stretch: Stretch) -> None:
    assert bench.asked("read", packed_stretches([stretch]))[0] is Code.OUTSIDE
    assert bench.asked("read", HEAD[:-1])[0] is Code.OUTSIDE


@pytest.mark.parametrize(
    ("asker", "what", "code"),
    [
        ("watcher", "read", Code.GRANTED),
        ("watcher", "stop", Code.NOT_PERMITTED),
        ("watcher", "give", Code.NOT_PERMITTED),
        ("nobody", "read", Code.NOT_PERMITTED),
        ("operator", "reset", Code.AT_THE_RACK),
    ],
)
def test_everybody_may_do_what_the_config_permits(
    bench: Bench, asker: str, what: str, code: Code
) -> None:
    assert bench.asked(what, HEAD, asker).code is code
    assert not bench.segment.words[System.EMERGENCY_STOP]


def test_a_program_of_another_version_is_refused(bench: Bench) -> None:
    bench.line.ask("read", HEAD, version=VERSION + 1)
    assert [got.answer.code for got in bench.cycle()] == [Code.OTHER_VERSION]


def test_what_is_malformed_unsigned_or_oversized_is_dropped_and_counted(bench: Bench) -> None:
    key = question_key(bench.segment.rack, "read", "operator")
    head = Envelope(VERSION, SESSION, 1, 0, 0, 0, 0)
    place = key.rpartition("/operator/")[0]

    def ask(key: str, sealed_for: str, payload: bytes) -> None:
        envelope = bench.line.sealer.seal(sealed_for, head, payload)
        bench.line.put(Question(key, envelope, payload, lambda *answer: pytest.fail("answered")))

    ask(key, question_key(bench.segment.rack, "read", "watcher"), HEAD)
    ask(key, key, bytes(MOST_QUESTION + 16))
    ask(f"{place}/operator/reset", f"{place}/operator/reset", b"")
    ask(f"{place}/../read", f"{place}/../read", HEAD)
    bench.line.put(Question(key, None, HEAD, lambda *answer: pytest.fail("answered")))
    bench.line.put(Question(key, b"RLN1", HEAD, lambda *answer: pytest.fail("answered")))
    assert bench.cycle() == []
    assert bench.desk.count.dropped == 6


def test_nobody_asks_in_the_name_of_another(bench: Bench, tmp_path: Path) -> None:
    make_credentials(tmp_path, dict.fromkeys((bench.segment.rack, *RIGHTS), ()), 1)
    rack, operator, watcher = (
        Sealer(Credentials(tmp_path, name)) for name in (bench.segment.rack, *RIGHTS)
    )
    bench.line.sealer = rack
    bench.desk.open(bench.line, LAUNCH)  # type: ignore[arg-type]
    bench.line.sealer = watcher
    bench.line.ask("stop", asker="operator")
    assert bench.cycle() == []
    assert bench.desk.count.dropped == 1
    assert not bench.segment.words[System.EMERGENCY_STOP]
    bench.line.sealer = operator
    # The answer has the seal of the rack, which `Line` checks.
    assert bench.asked("stop").code is Code.GRANTED
    assert bench.segment.words[System.EMERGENCY_STOP]


def test_a_flood_costs_a_cycle_no_more_than_its_bounds(bench: Bench) -> None:
    for _ in range(100):
        bench.line.ask("read", HEAD)
    counts = [len(bench.cycle()) for _ in range(3)]
    assert counts == [ANSWERS_A_CYCLE] * 3
    waiting = bench.line.waiting[f"rack/{bench.segment.rack}/ask/read"]
    waiting.clear()
    for _ in range(100):
        bench.line.ask("read", packed_stretches([Stretch(0, MOST_CONTENT)]))
    sizes = [len(got.answer.content) for got in bench.cycle()]
    assert sum(sizes) - sizes[-1] < BYTES_A_CYCLE <= sum(sizes)
    waiting.clear()
    for _ in range(100):
        bench.line.put(
            Question(question_key(bench.segment.rack, "read", "x"), b"", b"", lambda *answer: None)
        )
    before = bench.desk.count.dropped
    assert bench.cycle() == []
    assert bench.desk.count.dropped - before == QUESTIONS_A_CYCLE


def test_an_emergency_stop_comes_before_a_flood_and_is_found_once(bench: Bench) -> None:
    for _ in range(100):
        bench.line.ask("read", HEAD)
    bench.line.ask("stop")
    assert bench.cycle()[0].head.serial == 101
    assert bench.segment.words[System.EMERGENCY_STOP] == 1
    assert [(finding.alarm.name, finding.subject) for finding in bench.findings] == [
        ("REMOTE_STOP", 1)
    ]
    bench.line.ask("stop")
    assert bench.cycle()[0].answer.code is Code.GRANTED
    assert len(bench.findings) == 1


def test_a_command_gets_its_ticket_and_waits_as_long_as_its_client_asks(bench: Bench) -> None:
    answer = bench.asked("give", packed_request(bench.command(tick=10_000)))
    ticket = Ticket.unpacked(answer.content)
    assert answer.code is Code.GRANTED
    assert ticket is not None
    entry = OperatorTable(bench.segment).entries[ticket.entry]
    assert (entry.stage, entry[RequestWord.TICKET]) == (RequestStage.WAITING, ticket.number)
    assert [entry.index for entry in OperatorTable(bench.segment).waiting()] == [ticket.entry]
    assert bench.asked("read", HEAD).code is Code.GRANTED
    assert entry.stage is RequestStage.WAITING
    assert bench.asked("withdraw", ticket.packed(), "operator").code is Code.GRANTED
    assert entry.stage is RequestStage.FREE


def test_a_command_asked_for_again_is_given_once(bench: Bench) -> None:
    request = packed_request(bench.command(tick=10_000))
    first = bench.asked("give", request)
    bench.line.ask("give", request, again=1)
    (again,) = bench.cycle()
    assert again.answer.content == first.content
    assert len(OperatorTable(bench.segment).waiting()) == 1
    assert bench.asked("give", request).content != first.content


def test_commands_that_waited_while_the_rack_was_held_are_dropped_and_a_stop_is_not(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.cycle()
    later = time.monotonic_ns() + 10**9
    monkeypatch.setattr(desks.time, "monotonic_ns", lambda: later)
    bench.line.ask("give", packed_request(bench.command()))
    bench.line.ask("stop")
    assert [got.head.serial for got in bench.cycle()] == [2]
    assert bench.segment.words[System.EMERGENCY_STOP] == 1
    assert not OperatorTable(bench.segment).waiting()


def test_the_command_of_a_client_that_is_gone_is_withdrawn(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1_000_000_000
    monkeypatch.setattr(desks.time, "monotonic_ns", lambda: now)
    bench.asked("give", packed_request(bench.command(tick=10_000)))
    table = OperatorTable(bench.segment)
    now += 1_500_000_000
    bench.asked("read", HEAD)
    now += 1_500_000_000
    bench.cycle()
    assert len(table.waiting()) == 1
    now += 1_000_000_000
    bench.cycle()
    assert table.waiting() == []


def test_a_lease_ends_when_its_client_is_not_heard_or_withdraws_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1_000_000_000
    monkeypatch.setattr(desks.time, "monotonic_ns", lambda: now)
    table = OperatorTable(bench.segment)
    for is_withdrawn in (True, False):
        answer = bench.asked("lease", packed_request(bench.command()))
        ticket = Ticket.unpacked(answer.content)
        assert ticket is not None
        entry = table.entries[ticket.entry]
        entry.words[RequestWord.STAGE] = RequestStage.GIVEN
        for _ in range(3):
            now += 1_500_000_000
            bench.asked("read", HEAD)
            bench.segment.words[System.TICK] += 1
            bench.cycle()
            assert table.client_lives(entry)
            assert entry[RequestWord.HEARD] == bench.segment.words[System.TICK]
        if is_withdrawn:
            bench.asked("withdraw", ticket.packed())
        else:
            now += 2_500_000_000
            bench.cycle()
        assert table.leased() == [entry]
        assert not table.client_lives(entry)
        table.release(entry)


def test_the_desk_lets_go_of_a_lease_that_was_released(bench: Bench) -> None:
    ticket = Ticket.unpacked(bench.asked("lease", packed_request(bench.command())).content)
    assert ticket is not None
    table = OperatorTable(bench.segment)
    entry = table.entries[ticket.entry]
    entry.words[RequestWord.STAGE] = RequestStage.GIVEN
    table.release(entry)
    bench.cycle()
    assert not table.client_lives(entry)


def test_commands_that_make_no_sense_are_refused(bench: Bench) -> None:
    good = bench.command()
    assert bench.asked("give", packed_request(bench.command(tick=8))).code is Code.PAST
    assert bench.asked("give", b"").code is Code.NOT_VALID
    assert bench.asked("give", packed_request(Request(9999, good.message))).code is Code.NOT_VALID
    assert bench.asked("give", packed_request(Request(0, good.message))).code is Code.NOT_VALID
    assert (
        bench.asked("give", packed_request(Request(good.mailbox, good.message[:-1]))).code
        is Code.NOT_VALID
    )
    assert (
        bench.asked("give", packed_request(Request(good.mailbox, b"\xff" * len(good.message)))).code
        is Code.NOT_VALID
    )
    assert not OperatorTable(bench.segment).waiting()


def test_clients_cannot_fill_the_table(bench: Bench) -> None:
    for _ in range(desks.MOST_CLIENTS):
        assert bench.asked("give", packed_request(bench.command(tick=10_000))).code is Code.GRANTED
    assert bench.asked("give", packed_request(bench.command(tick=10_000))).code is Code.FULL
    # A place is free again once its client has gone on.
    (first, *_) = OperatorTable(bench.segment).waiting()
    first.words[RequestWord.STAGE] = RequestStage.FREE
    bench.cycle()
    assert bench.asked("give", packed_request(bench.command(tick=10_000))).code is Code.GRANTED


def test_a_tick_that_has_come_is_past_and_the_next_is_not(bench: Bench) -> None:
    now = bench.tick + 8
    assert bench.asked("give", packed_request(bench.command(tick=now))).code is Code.PAST
    now = bench.tick + 8
    assert bench.asked("give", packed_request(bench.command(tick=now + 1))).code is Code.GRANTED


def test_a_client_withdraws_its_own_commands_alone(bench: Bench) -> None:
    ticket = bench.asked("give", packed_request(bench.command(tick=10_000))).content
    other = Ticket.unpacked(ticket)
    assert other is not None
    bench.asked("withdraw", Ticket(other.entry, other.number + 1).packed())
    assert len(OperatorTable(bench.segment).waiting()) == 1
    bench.asked("withdraw", b"")
    assert len(OperatorTable(bench.segment).waiting()) == 1
    bench.asked("withdraw", ticket)
    assert OperatorTable(bench.segment).waiting() == []


def test_a_desk_counts_on_from_its_predecessor_and_in_lockstep_shows_nothing(
    bench: Bench,
) -> None:
    group = np.zeros((), [("answered", "u4"), ("refused", "u4"), ("dropped", "u4")])
    bench.asked("read", HEAD)
    bench.asked("stop", b"", "watcher")
    bench.desk.fill(group)
    assert group.tolist() == (1, 1, 0)
    group["dropped"] = 7
    successor = Desk(bench.segment, OwnGrid(bench.segment, 8), Permit(RIGHTS, ("o",)), [])  # type: ignore[arg-type]
    successor.resume(group)
    blank = np.zeros_like(group)
    successor.fill(blank)
    assert blank.tolist() == (1, 1, 7)
    bench.segment.words[System.LOCKSTEP] = 1
    stepped = Desk(bench.segment, OwnGrid(bench.segment, 8), Permit(RIGHTS, ("o",)), [])  # type: ignore[arg-type]
    stepped.resume(group)
    blank = np.zeros_like(group)
    stepped.fill(blank)
    assert blank.tolist() == (0, 0, 0)


def test_those_who_watch_see_the_end_and_others_are_not_waited_for(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(desks, "LINGER_S", 60.0)
    began = time.monotonic()
    bench.desk.close()
    assert time.monotonic() - began < 60.0
    monkeypatch.setattr(desks, "LINGER_S", 0.05)
    bench.asked("read", HEAD)
    bench.line.ask("read", HEAD)
    bench.line.ask("stop")
    began = time.monotonic()
    bench.line.answers.clear()
    bench.desk.close()
    assert time.monotonic() - began >= 0.05
    assert [got.answer.code for got in bench.line.answers] == [Code.GRANTED]
    assert bench.segment.words[System.EMERGENCY_STOP] == 0
