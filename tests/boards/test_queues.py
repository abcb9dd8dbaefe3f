"""Racks with queues: nothing lost or repeated, killed boards, repeatable runs, and what `rack
check` refuses."""

from __future__ import annotations

import os
import random
import signal

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.words import Block
from rack.boards import Rack
from tests.boards.config.mistakes import find_lines, find_mistake
from tests.boards.conftest import CLOCK, MakeConfig, format_board
from tests.boards.fault_racks import inline
from tests.boards.runs import faulty, kill, stop, watch_until

QUEUES = (
    CLOCK
    + format_board("upper", 2, "queue_levels:Asking", core=1, rate_hz=10, params={"burst": 3})
    + format_board("lower", 3, "queue_levels:Answering", rate_hz=4, above="upper")
)
FAST = (
    "board.upper.rate_hz=100",
    "board.lower.rate_hz=50",
    # Room for what is sent during a restart that takes ten seconds.
    "protocol.depth={ 'upper.requests' = 4096 }",
)
PLANNER = {"planner": "queue_levels:Stepping", "coupling": "tight", "within_cycles": 2}
PLANNING = CLOCK + format_board(
    "wave", 2, "queue_levels:Steady", rate_hz=50, params={"burst": 5}, **PLANNER
)


def counts(rack: Rack, board: str) -> dict[str, int]:
    """Return the counts in the newest status of a board."""
    status = open_observer(rack.segment, f"{board}.status").peek().message
    names = status.record.dtype.names
    return {
        name: int(status.record[name]) for name in names if status.record[name].dtype.kind != "S"
    }


@pytest.mark.slow
def test_runs_with_a_full_queue_and_killed_boards_repeat(config: MakeConfig) -> None:
    plain = config("protocol.depth={ 'upper.requests' = 7 }", text=QUEUES)
    found = faulty(plain, kill("upper", 97), kill("lower", 501))
    digests = set()
    for _ in range(2):
        with Rack(found) as rack:
            digests.add(rack.run(4.0).digest)
            assert counts(rack, "upper")["refused"] > 0
            assert counts(rack, "lower")["repeated"] == 0
            assert [e.text for e in rack.events if e.code == "queue_full"]
    assert len(digests) == 1


def await_cycles(rack: Rack, board: str) -> None:
    """Wait until a board is there and has cycled again."""
    block = rack.segment.get_block(board)
    cycles = block[Block.CYCLES]
    watch_until(rack, lambda: not block[Block.LOST] and block[Block.CYCLES] >= cycles + 3)


def kill_often(rack: Rack, board: str, times: int, rng: random.Random) -> None:
    """Kill a board's process that often, at random instants, and wait until it cycles again."""
    block = rack.segment.get_block(board)
    for _ in range(times):
        await_cycles(rack, board)
        rack.watch(rng.uniform(0.0, 0.03))
        pid = block[Block.PID]
        os.kill(pid, signal.SIGKILL)
        watch_until(rack, lambda pid=pid: block[Block.LOST] or block[Block.PID] != pid)  # type: ignore[misc]


REALTIME = ("clock.mode=realtime", "supervision.restarts=100", *FAST)


@pytest.mark.slow
def test_a_killed_reader_repeats_nothing_and_loses_at_most_the_cycle_it_died_in(
    config: MakeConfig,
) -> None:
    with Rack(config(*REALTIME, "board.lower.params.most=8", text=QUEUES)) as rack:
        rack.start(60.0)
        kill_often(rack, "lower", 2, random.Random(1))
        found = settle(rack)
        rows, lost = MailboxRing(rack.segment, "upper.requests").read_new_rows()
        assert not lost
        # A cycle that the writer misses on a busy machine sends nothing.
        sent = int(np.count_nonzero(rows["message"]["id"] <= found["newest"]))
        assert 0 <= sent - found["taken"] <= 2 * 8
        assert found["repeated"] == counts(rack, "upper")["refused"] == 0


@pytest.mark.slow
def test_a_killed_writer_sends_all_requests_of_a_cycle_or_none(config: MakeConfig) -> None:
    with Rack(config(*REALTIME, text=QUEUES)) as rack:
        rack.start(60.0)
        kill_often(rack, "upper", 2, random.Random(2))
        found = settle(rack)
        rows, lost = MailboxRing(rack.segment, "upper.requests").read_new_rows()
    assert not lost
    ids, ticks = rows["message"]["id"].tolist(), rows["tick"].tolist()
    assert ids == sorted(set(ids))
    assert [ids[at : at + 3] for at in range(0, len(ids), 3)] == [
        [at, at + 1, at + 2] for at in ids[::3]
    ]
    assert [ticks.count(tick) for tick in set(ticks)] == [3] * len(set(ticks))
    assert found["repeated"] == 0
    assert found["missing"] % 3 == 0
    assert len(set(rows["epoch"].tolist())) == 3


def settle(rack: Rack) -> dict[str, int]:
    """Let a rack run on until both boards have cycled again, the reader last, then stop it; return
    the reader's counts."""
    for board in ("upper", "lower"):
        await_cycles(rack, board)
    stop(rack)
    return counts(rack, "lower")


@pytest.mark.slow
def test_a_planner_takes_every_request_between_its_plans(config: MakeConfig) -> None:
    planner = ("board.lower.executor=queue_levels:Filed", "board.lower.planner=queue_levels:Filing")
    slow = ("board.lower.coupling=tight", "board.lower.rate_hz=50", "board.lower.within_cycles=30")
    digests = set()
    for _ in range(2):
        with Rack(config("board.upper.params.until=360", *planner, *slow, text=QUEUES)) as rack:
            digests.add(rack.run(3.0).digest)
            found = counts(rack, "lower")
            assert (found["taken"], found["newest"], found["repeated"], found["missing"]) == (
                27,
                27,
                0,
                0,
            )
    assert len(digests) == 1


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        (
            "board.third={ slot = 4, every = 1, above = 'upper', executor ="
            " 'queue_levels:Answering' }",
            "mailbox upper.requests: a queue gives each message once, so it has one reader, not"
            " 2: lower (requests)",
        ),
        ("board.lower.reads.requests=lower.requests", "no task writes it"),
        ("protocol.default=queue", 'protocol.default = "queue"'),
        (
            "protocol.mailbox={ 'upper.requests' = 'time-slice' }",
            "sends any number of messages in a cycle",
        ),
        (
            "protocol.depth={ 'upper.status' = 3 }",
            "it is not a queue and holds one message; queues: upper.requests",
        ),
        ("protocol.depth={ 'upper.nothing' = 3 }", "no such mailbox"),
        ("protocol.depth={ 'upper.requests' = 0 }", "protocol.depth"),
    ],
)
def test_invalid_queues_are_refused_in_one_line(setting: str, expected: str) -> None:
    assert sum(expected in line for line in find_lines(QUEUES, setting)) == 1


def test_a_queue_without_a_reader_is_refused() -> None:
    found = find_mistake(QUEUES.partition("[board.lower]")[0])
    assert "mailbox upper.requests: no task reads this queue" in found


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        (
            {"kind": "mute", "mailbox": "upper.requests"},
            "'upper.requests' is a queue, which mute does not strike",
        ),
        ({"kind": "babble", "mailbox": "upper.requests"}, "refuses those that it cannot hold"),
        (
            {"kind": "drop", "board": "lower", "mailbox": "upper.requests_taken"},
            "'lower' does not write it",
        ),
    ],
)
def test_faults_that_a_queue_cannot_show_are_refused(fault: dict[str, str], why: str) -> None:
    assert why in find_mistake(QUEUES, f"fault=[{inline({'board': 'upper'} | fault)}]")
