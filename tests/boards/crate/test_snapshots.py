"""A rack in lockstep goes on from each of its snapshots, any number of times, to the same
digest."""

from __future__ import annotations

import json
import os
import random
import signal
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.process import is_alive, list_children, wait_readable
from rack.backplane.standby import list_standbys
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.crate.clean import remove_dead_rack
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import NO_SNAPSHOTS_PREFIX, SnapshotError
from rack.boards.events import Event, Outcome
from rack.boards.wiring import Continuation, SnapshotPolicy
from tests.boards.config.mistakes import read_config
from tests.boards.conftest import LOOSE, PLANNED, MakeConfig
from tests.boards.remembering_racks import REMEMBERING
from tests.boards.runs import digest_of, faulty, kill
from tests.processes import BOUND_S, FORKS, forked, wait_until

pytestmark = pytest.mark.slow
SECONDS = 1.0
OFTEN = SnapshotPolicy(every=100)


@pytest.fixture
def crate() -> Iterator[WarmCrate]:
    with WarmCrate() as crate:
        yield crate


def taken(
    config: RackConfig, crate: WarmCrate, snapshots: SnapshotPolicy = OFTEN
) -> tuple[Outcome, list[Event]]:
    """Run a rack that takes snapshots."""
    with Rack(config, crate=crate, snapshots=snapshots) as rack:
        return rack.run(SECONDS), rack.events


def digests_of_a_chain(
    config: RackConfig, crate: WarmCrate, *ticks: int, seconds: float = SECONDS
) -> set[str]:
    """Run a rack so often that it has a snapshot at each of these ticks, in this order: each run
    goes on from the last snapshot and takes the next one. Return the digests of all runs."""
    digests = set()
    for tick in ticks:
        begins = Continuation(tick, faults=len(config.fault)) if tick != ticks[0] else None
        wanted = SnapshotPolicy(part=0, at=tick)
        with Rack(config, crate=crate, snapshots=wanted, continues=begins) as rack:
            digests.add(rack.run(seconds).digest)
            if begins is not None:
                assert rack.begins_at == max(at for at in ticks if at < tick)
    return digests


def continued(
    config: RackConfig,
    crate: WarmCrate,
    tick: int,
    known: RackConfig | None = None,
    seconds: float | None = SECONDS,
    **losses: Any,
) -> Outcome:
    """Go on from the last snapshot at a tick or before, of a run of `known` or the same config."""
    begins = Continuation(tick, faults=len((known or config).fault), **losses)
    with Rack(config, crate=crate, continues=begins) as rack:
        return rack.run(seconds)


def ticks_on(crate: WarmCrate) -> list[int]:
    """Return the ticks of all snapshots."""
    found = [crate.read_attributes(1 << 40, "").tick]
    while found[-1] > 0:
        found.append(crate.read_attributes(found[-1] - 1, "").tick)
    return [tick for tick in found[::-1] if tick >= 0]


@pytest.mark.parametrize(
    "settings",
    [
        (),
        pytest.param(LOOSE, marks=pytest.mark.thorough),
        pytest.param(("protocol.default=lock",), marks=pytest.mark.thorough),
    ],
)
def test_a_run_continues_from_each_snapshot_to_the_same_digest(
    config: MakeConfig, crate: WarmCrate, settings: Sequence[str]
) -> None:
    rack = config(*settings)
    expected = digest_of(rack, SECONDS)
    ticks = (0, *sorted(random.Random(1).sample(range(1, 400), 3)))
    assert digests_of_a_chain(rack, crate, *ticks) == {expected}
    assert ticks_on(crate) == [*ticks]
    for tick in (399, ticks[2], ticks[2]):
        again = continued(rack, crate, tick)
        assert (again.digest, again.ticks) == (expected, 400), tick


LOST_AT = 150
BACK_AT = 220
KILLED = kill("wave", LOST_AT)
BOARD = "board.wave.standby={slot=9,core=0}"
BOTH = (BOARD, "board.watch.standby={slot=10,core=1}")
CLOCK = "clock.standby={slot=11,core=0}"
STANDBYS: Mapping[str, tuple[Sequence[str], Sequence[Mapping[str, Any]], int]] = {
    "board, killed": ((BOARD,), (KILLED,), 1),
    "board, hanging": ((BOARD,), ({"kind": "hang", "board": "wave", "tick": LOST_AT},), 1),
    "board, both killed": ((BOARD,), (KILLED, kill("wave.standby", BACK_AT + 50)), 2),
    "two boards, killed": (BOTH, (KILLED, kill("watch", LOST_AT)), 2),
    "clock, killed": ((CLOCK,), (kill("clock", LOST_AT),), 0),
    "clock and board, both killed": (
        (CLOCK, BOARD),
        (kill("clock", LOST_AT), kill("wave", LOST_AT + 10)),
        1,
    ),
}
"""Standbys, faults, and the number of hand-overs of boards in the whole run."""


@pytest.fixture(scope="module")
def plain() -> str:
    """Digest of the rack without standbys and faults."""
    return digest_of(read_config(PLANNED, [f"name=test-unsnapped-{os.getpid()}"]), SECONDS)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=() if case == "board, both killed" else pytest.mark.thorough)
        for case in STANDBYS
    ],
)
def test_a_rack_with_a_standby_continues_to_the_digest_of_the_original(
    config: MakeConfig, crate: WarmCrate, plain: str, case: str
) -> None:
    standbys, faults, hand_overs = STANDBYS[case]
    rack = faulty(config(*standbys, "supervision.lockstep_restart_s=0.05", text=PLANNED), *faults)
    ticks = (LOST_AT - 1, LOST_AT, BACK_AT, 350)
    for tick in ticks:
        begins = Continuation(tick, faults=len(rack.fault)) if tick != ticks[0] else None
        wanted = SnapshotPolicy(part=0, at=tick)
        with Rack(rack, crate=crate, snapshots=wanted, continues=begins) as taking:
            assert taking.run(SECONDS).digest == plain, tick
    # A snapshot that is due while a copy is lost is taken once it is back.
    assert {LOST_AT - 1, BACK_AT, 350} <= {*ticks_on(crate)}
    # The chain has begun once at each of the others.
    for tick in (350, LOST_AT):
        begins = Continuation(tick, faults=len(rack.fault))
        with Rack(rack, crate=crate, continues=begins) as again:
            assert again.run(SECONDS).digest == plain, tick
            found = sum(task.hand_overs for task in list_standbys(again.segment))
        assert found == hand_overs, tick


SLOW: Sequence[tuple[Mapping[str, Any], Sequence[int]]] = (
    ({"kind": "overrun", "board": "wave", "tick": 100, "cycles": 3, "by": 2.5}, (101, 102, 105)),
    ({"kind": "overrun", "board": "watch", "tick": 120, "cycles": 1, "by": 2.5}, (121, 130)),
    (
        {"kind": "planner-slow", "board": "wave.planner", "tick": 152, "cycles": 1, "by": 3.0},
        (153, 158),
    ),
    ({"kind": "hog", "board": "wave", "tick": 176, "cycles": 6}, (177, 179)),
    ({"kind": "clock-jitter", "board": "clock", "tick": 190, "cycles": 6}, (191, 193)),
)
"""Faults that take simulated time, and ticks while they do."""


@pytest.mark.thorough
def test_a_run_continues_from_the_middle_of_a_cycle_that_takes_simulated_time(
    config: MakeConfig, crate: WarmCrate
) -> None:
    rack, seconds = faulty(config(), *(fault for fault, _ in SLOW)), 0.55
    with Rack(rack) as plain:
        expected = plain.run(seconds)
        missed = [event.tick for event in plain.events if event.kind == "miss"]
    ticks = [tick for _, those in SLOW for tick in those]
    for fault, _ in SLOW:
        begins = fault["tick"]
        assert [tick for tick in missed if begins <= tick < begins + 10], fault
    assert digests_of_a_chain(rack, crate, *ticks, seconds=seconds) == {expected.digest}
    assert ticks_on(crate) == ticks
    assert continued(rack, crate, ticks[-1], seconds=seconds).digest == expected.digest


@pytest.mark.parametrize("level", ["Rememberer", "Holder"])
def test_a_snapshot_contains_the_whole_state_of_a_level(
    config: MakeConfig, crate: WarmCrate, level: str
) -> None:
    rack = config(text=REMEMBERING.replace("Rememberer", level))
    expected = digest_of(rack, SECONDS)
    assert digests_of_a_chain(rack, crate, 210, 300) == {expected}
    assert ticks_on(crate) == [210, 300]
    for tick in (300, 210):
        assert continued(rack, crate, tick).digest == expected


def test_a_snapshot_shows_the_attributes_of_its_levels(
    config: MakeConfig, crate: WarmCrate
) -> None:
    taken(config(text=REMEMBERING), crate, SnapshotPolicy(part=0, at=210))
    found = crate.read_attributes(399, "wave")
    assert found.tick == 210
    shown = json.loads(found.attributes)
    assert (shown["_factor"], shown["_half"], shown["_list"]) == (1.0, 0.5, "210 items")
    assert shown["_recent"] == [tick % 7 for tick in range(205, 210)]
    assert sorted(shown["_odd"]) == [tick for tick in range(13) if len(range(tick, 210, 13)) % 2]
    turned = 0.125 * len(range(20, 210))
    assert shown["_turn"] == {"of": [turned, 0.0], "size": 0.125}
    # Shared state is shown as it is; functions are not.
    assert shown["_table"] == [[0.0, 0.0, 0.0], [0.0, turned, 0.0]]
    assert not {"context", "_call", "_next"} & set(shown)


def test_a_finished_task_ends_the_continued_run(config: MakeConfig, crate: WarmCrate) -> None:
    rack = config("board.wave.params.done_at=100")
    with Rack(rack) as plain:
        expected = plain.run()
    taken(rack, crate, SnapshotPolicy(part=0, at=140))
    outcome = continued(rack, crate, 140, seconds=None)
    assert (outcome.cause, outcome.ticks) == ("task done", expected.ticks)
    assert outcome.digest == expected.digest


@pytest.mark.thorough
def test_a_branch_differs_after_its_snapshot(config: MakeConfig, crate: WarmCrate) -> None:
    rack = config(text=REMEMBERING)
    outcome, _ = taken(rack, crate, SnapshotPolicy(part=0, at=210))
    other = config("board.wave.params.factor=2.0", text=REMEMBERING)
    struck = faulty(rack, kill("wave", 220))
    branches = [continued(other, crate, 210), continued(struck, crate, 210, known=rack)]
    assert len({outcome.digest, *(branch.digest for branch in branches)}) == 3
    assert digest_of(other, SECONDS) not in (outcome.digest, branches[0].digest)
    # The snapshot itself is as it was.
    assert continued(rack, crate, 210).digest == outcome.digest


@pytest.mark.thorough
def test_a_run_with_faults_restarts_and_skipped_ticks_can_be_continued(
    config: MakeConfig, crate: WarmCrate
) -> None:
    rack = faulty(
        config("supervision.lockstep_restart_s=0.1"),
        kill("wave", 100),
        {"kind": "drop", "board": "wave", "mailbox": "wave.status", "tick": 60, "cycles": 9},
        {"kind": "clock-skip", "board": "clock", "tick": 180},
        kill("wave.planner", 250),
    )
    ticks = (65, 99, 141, 180, 181, 249, 300)
    expected = digest_of(rack, SECONDS)
    assert digests_of_a_chain(rack, crate, *ticks) == {expected}
    for tick in (110, 270):
        # None falls into an outage, of 40 ticks.
        taken(rack, crate, SnapshotPolicy(part=0, at=tick))
    assert ticks_on(crate) == [*ticks]
    for tick in (ticks[-1], 65):
        assert continued(rack, crate, tick).digest == expected, tick


def test_restarts_before_a_snapshot_count_after_it(config: MakeConfig, crate: WarmCrate) -> None:
    settings = ("supervision.restarts=1", "supervision.lockstep_restart_s=0.1")
    rack = faulty(config(*settings), kill("wave", 20), kill("wave", 100))
    outcome, _ = taken(rack, crate, SnapshotPolicy(part=0, at=70))
    assert outcome.cause == "board lost"
    again = continued(rack, crate, 70, losses=(("wave", 20),))
    assert (again.cause, again.digest) == (outcome.cause, outcome.digest)


@pytest.mark.parametrize(
    ("holds", "named"),
    [
        ("file", "it holds /"),
        ("socket", "it holds socket:"),
        ("epoll", "it holds anon_inode:"),
        ("thread", "it runs the thread "),
    ],
)
def test_a_level_that_cannot_be_copied_is_named_and_runs_as_before(
    config: MakeConfig, crate: WarmCrate, tmp_path: Path, holds: str, named: str
) -> None:
    settings = (f"board.wave.params.holds={holds}", f"board.wave.params.path={tmp_path / 'log'}")
    rack = config(*settings, text=REMEMBERING.replace("Rememberer", "Uncopied"))
    expected = digest_of(rack, SECONDS)
    outcome, events = taken(rack, crate, SnapshotPolicy(part=1, every=10))
    assert (outcome.cause, outcome.digest) == ("time over", expected)
    # Once: it is not tried again.
    (note,) = [event.text for event in events if event.kind == "ready"]
    assert note.startswith(f"{NO_SNAPSHOTS_PREFIX}wave: {named}")
    assert ticks_on(crate) == []


def test_without_a_snapshot_and_in_real_time_a_rack_is_refused(
    config: MakeConfig, crate: WarmCrate
) -> None:
    with pytest.raises(SnapshotError, match="no snapshot before tick 100"):
        continued(config(), crate, 100)
    with pytest.raises(SnapshotError, match="add --lockstep"):
        taken(config("clock.mode=realtime"), crate)


def copies_of(crate: WarmCrate) -> set[int]:
    """Return the processes of a crate between two racks: copies that wait."""
    return {pid for pid in list_children(crate.pid) if is_alive(pid)}


def test_snapshots_end_with_their_crate_however_that_ends(config: MakeConfig) -> None:
    for how in (signal.SIGKILL, signal.SIGTERM, None):
        with WarmCrate() as crate:
            taken(config(), crate, SnapshotPolicy(part=0, at=100))
            pids = copies_of(crate)
            assert len(pids) == len(config().board) + 2  # a planner, and the clock
            if how is signal.SIGKILL:
                os.kill(crate.pid, how)
                wait_until(lambda pids=pids: not any(map(is_alive, pids)))
        assert not any(map(is_alive, pids))


def test_a_snapshot_that_has_lost_a_copy_is_dropped(config: MakeConfig, crate: WarmCrate) -> None:
    rack = config()
    outcome, _ = taken(rack, crate, SnapshotPolicy(part=0, at=100))
    earlier = copies_of(crate)
    taken(rack, crate, SnapshotPolicy(part=0, at=200))
    lost = copies_of(crate) - earlier
    os.kill(min(lost), signal.SIGKILL)
    wait_until(lambda: not is_alive(min(lost)))
    assert ticks_on(crate) == [100]
    wait_until(lambda: copies_of(crate) == earlier)
    assert continued(rack, crate, 250).digest == outcome.digest


def test_a_continued_board_is_restarted_when_it_is_killed(
    config: MakeConfig, crate: WarmCrate
) -> None:
    rack = faulty(config("supervision.lockstep_restart_s=0.1"), kill("wave", 300))
    outcome, events = taken(rack, crate, SnapshotPolicy(part=0, at=200))
    with Rack(rack, crate=crate, continues=Continuation(200, faults=1)) as again:
        assert again.run(SECONDS).digest == outcome.digest
    restarts = [event.board for event in again.events if event.code == "restart"]
    assert restarts == [event.board for event in events if event.code == "restart"] == ["wave"]


def test_a_running_rack_publishes_its_number_of_snapshots(
    config: MakeConfig, crate: WarmCrate
) -> None:
    with Rack(config(), crate=crate, snapshots=OFTEN) as rack:
        rack.run(SECONDS)
        words = rack.segment.words
        count, size = words[System.SNAPSHOTS], words[System.SNAPSHOT_BYTES]
        segment = len(rack.segment.bytes)
    assert count >= 1
    assert size >= count * segment // 2


def family_of(pid: int) -> set[int]:
    """Return a process, its children and theirs."""
    children = list_children(pid)
    return {pid, *children}.union(*map(list_children, children))


@pytest.mark.filterwarnings(FORKS)
def test_nothing_is_left_of_snapshots_whose_launcher_is_killed(config: MakeConfig) -> None:
    rack = config()
    begun, begins = os.pipe()

    def launch() -> None:
        with WarmCrate() as crate:
            taken(rack, crate, SnapshotPolicy(part=0, at=100))
            # The rack that goes on runs until it is killed.
            with Rack(rack, crate=crate, continues=Continuation(100)) as again:
                again.start(1e6)
                os.write(begins, crate.pid.to_bytes(4, "little"))
                while again.watch(1.0):
                    continue

    with forked(launch) as launcher:
        assert wait_readable(begun, BOUND_S)
        crate = int.from_bytes(os.read(begun, 4), "little")
        # The crate, clock, planner and boards, and the copies that wait in their places.
        wait_until(lambda: len(family_of(crate)) > 2 * (len(rack.board) + 2))
        family = family_of(crate)
        os.kill(launcher, signal.SIGKILL)
        wait_until(lambda: not any(map(is_alive, family)))
    remove_dead_rack(rack.name)
