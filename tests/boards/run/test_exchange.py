"""The exchange of a board: ports read in every n-th cycle or asynchronously, and the record of ages
and arrivals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Verdict
from rack.boards import Rack
from rack.boards.exchange import PortAge
from rack.tools.monitor.snapshot import RackMonitor
from tests.boards.config.mistakes import find_lines, find_mistake
from tests.boards.conftest import CLOCK, MakeConfig, format_board
from tests.boards.messages import Written, run_and_read
from tests.boards.runs import digest_of, faulty, kill

WAVE, NOTES = (2, 1), (3, 2)
"""Period and phase of the writer and of the reader, ticks."""
SPARSE = (4, 1)
"""Period and phase of the port that is read now and then, cycles."""
NO_TABLE = (
    CLOCK
    + format_board("wave", 2, "wave_levels:Wave", every=WAVE[0], phase=WAVE[1])
    + format_board(
        "notes", 3, "recording_levels:Notes", every=NOTES[0], phase=NOTES[1], below="wave"
    )
)
TEXT = f"""{NO_TABLE}
[board.notes.exchange]
sparse = {{ every = {SPARSE[0]}, phase = {SPARSE[1]} }}
early = {{ asynchronous = true }}
"""
TICKS = 100
SECONDS = 0.25


def model(port: str) -> list[tuple[int, int]]:
    """Return what the record of a port must show in each cycle."""
    (every, phase), found, made, taken = NOTES, [], -1, -1
    for cycle, tick in enumerate(range(phase, TICKS, every)):
        if port != "sparse" or cycle % SPARSE[0] == SPARSE[1]:
            # The faster board goes first in a tick. What it released last and is visible:
            visible = tick - (0 if port == "early" else WAVE[0])
            seen = visible - (visible - WAVE[1]) % WAVE[0]
            if seen > made:
                made, taken = seen, tick
        found.append((tick - made if made >= 0 else 0, taken))
    return found


@pytest.mark.slow
def test_ages_and_arrivals_follow_the_configured_exchange_and_runs_repeat(
    config: MakeConfig,
) -> None:
    with Rack(config(text=TEXT)) as rack:
        digest = rack.run(SECONDS).digest
        found = Written.on(rack.segment).messages
        looked = RackMonitor(rack.segment).take_snapshot()
    seen, record = found["notes.status"], found["notes.exchange"]
    for at, port in enumerate(("plain", "sparse", "early")):
        age, taken = (record["message"][f"{port}_{name}"] for name in ("age", "taken"))
        assert list(zip(age.tolist(), taken.tolist(), strict=True)) == model(port)
        # Until the next exchange the level sees the last reading as an old one.
        made = seen["tick"] - age
        values = np.where(taken < 0, 0.0, 0.5 * made)
        assert seen["message"]["value"][:, at].tolist() == values.tolist()
        verdicts = np.where(
            taken < 0, Verdict.NONE, np.where(taken == seen["tick"], Verdict.NEW, Verdict.OLD)
        )
        assert seen["message"]["verdict"][:, at].tolist() == verdicts.tolist()
        assert not seen["message"]["lost"][:, at].any()
        assert looked.exchanges["notes"][port] == PortAge(*model(port)[-1])
    assert digest_of(config(text=TEXT), SECONDS) == digest


@pytest.mark.slow
def test_a_port_that_is_read_rarely_raises_no_alarm(config: MakeConfig) -> None:
    with Rack(config("board.notes.exchange.sparse.every=50", text=TEXT)) as rack:
        rack.run(1.5)
        assert [event for event in rack.events if event.kind == "detection"] == []


QUEUE = (
    "protocol.mailbox={ 'wave.status' = 'queue' }",
    "board.notes.executor='wave_levels:Watch'",
    "board.notes.exchange={ below = { every = 4, phase = 1 } }",
)


@pytest.mark.slow
def test_a_queue_is_emptied_at_every_exchange_without_refused_messages(
    config: MakeConfig,
) -> None:
    with Rack(config(*QUEUE, text=NO_TABLE)) as rack:
        rack.run(1.5)
        assert [event for event in rack.events if event.kind == "detection"] == []
        found = Written.on(rack.segment).messages
    (every, phase), (cycles, first) = NOTES, SPARSE
    taken, sent = found["wave.status_taken"], found["wave.status"]
    assert taken["tick"].tolist() == list(range(phase + every * first, 600, every * cycles))
    counts = [int(np.sum(sent["visible_at"] <= tick)) for tick in taken["tick"]]
    assert taken["message"]["taken"].tolist() == counts
    assert not taken["message"]["unread"].any()


def test_a_queue_is_not_read_asynchronously() -> None:
    wanted = "board.notes.exchange={ below = { asynchronous = true } }"
    assert find_mistake(NO_TABLE, *QUEUE[:2], wanted).startswith(
        "board.notes.exchange.below.asynchronous = true: 'wave.status' has protocol queue"
    )


def killed(config: MakeConfig, victim: str) -> Any:
    """Return the rows of the reader's record and status after the death of a board at tick 41."""
    plain = config("supervision.lockstep_restart_s=0.1", text=TEXT)
    return run_and_read(Rack(faulty(plain, kill(victim, 41))), 2 * SECONDS).messages


@pytest.mark.slow
def test_a_restarted_board_keeps_the_grid_of_its_exchange(config: MakeConfig) -> None:
    rows = killed(config, "notes")["notes.exchange"]
    back = int(np.flatnonzero(np.diff(rows["tick"]) > NOTES[0])[0]) + 1
    assert rows["tick"][back] > 41
    taken = rows["message"]["sparse_taken"]
    fresh = sorted({int(tick) for tick in taken[taken >= 0]})
    every, first = NOTES[0] * SPARSE[0], NOTES[1] + NOTES[0] * SPARSE[1]
    assert {tick % every for tick in fresh} == {first}
    assert fresh[0] < 41 < fresh[-1]
    # Its new process knows no message before its first exchange.
    waiting = rows["tick"][back:] < next(tick for tick in fresh if tick >= rows["tick"][back])
    assert (taken[back:][waiting] == -1).all()


@pytest.mark.slow
def test_a_lost_writer_shows_between_two_exchanges(config: MakeConfig) -> None:
    rows = killed(config, "wave")["notes.status"]
    lost = rows["message"]["lost"][(rows["tick"] > 42) & (rows["tick"] < 41 + 40)]
    assert len(lost) > 2 * SPARSE[0]
    assert lost.all()
    assert not rows["message"]["lost"][rows["tick"] > 41 + 40 + 3 * NOTES[0] * SPARSE[0]].any()


def test_a_level_that_writes_a_mailbox_of_that_name_cannot_have_an_exchange() -> None:
    found = find_lines(TEXT, "board.notes.executor='recording_levels:Exchanging'")
    why = "board.notes.exchange: the executor itself writes a mailbox of this name; "
    assert found[0].startswith(why)
