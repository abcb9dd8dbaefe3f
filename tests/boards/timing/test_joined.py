"""Racks joined by links: bounds of the response across them, and mistakes of their configs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from rack.backplane.layout import TickGrid
from rack.boards.config import CONFIGS, RackConfig, load
from rack.boards.config.joined import join_racks, load_partners
from rack.boards.errors import ConfigError
from rack.boards.timing.joined import JoinedPath, JoinedRacks, RackLink, Station
from rack.tools.console.answer import Failure
from rack.tools.timing.joined_check import format_joined_verdicts, judge_joined_racks

MS = 1_000_000
LOCKSTEP = "clock.mode=lockstep"


def join(*names: str) -> JoinedRacks:
    return join_racks([load(name) for name in names])


def join_brown(*settings: str) -> JoinedRacks:
    return join_racks([load(name, settings) for name in ("brown", "brown/servo")])


def find_path(paths: Sequence[JoinedPath], direction: str, first: str) -> JoinedPath:
    """Return the first path in a direction that begins at a board of a rack."""
    found = [path for path in paths if "/".join(path.stations[0]) == first]
    return next(path for path in found if path.direction == direction)


@pytest.mark.parametrize(
    ("written", "read", "is_lockstep", "max_lost", "expected_ms"),
    [
        # The export is just missed: 18 of 20 ms, as the writer's messages appear every 2 ms. In
        # lockstep the exchange takes no simulated time, and nothing is lost.
        (TickGrid(2 * MS), TickGrid(10 * MS), True, 0, 18 + 10 + 0),
        (TickGrid(2 * MS), TickGrid(10 * MS), True, 3, 18 + 10 + 0),
        # In real time the delay is added, and a whole period of the import, because the phases of
        # the two racks are unknown.
        (TickGrid(2 * MS), TickGrid(10 * MS), False, 0, 18 + 5 + 20 + 10),
        (TickGrid(2 * MS), TickGrid(10 * MS), False, 2, 18 + 40 + 5 + 20 + 10),
        # A slow writer's messages appear when they are exported; a slow reader waits for its cycle.
        (TickGrid(20 * MS), TickGrid(100 * MS), True, 0, 0 + 10 + 90),
    ],
)
def test_a_link_takes_its_waits_its_delay_and_its_losses(
    written: TickGrid, read: TickGrid, is_lockstep: bool, max_lost: int, expected_ms: int
) -> None:
    grid = TickGrid(20 * MS)
    ends = Station("upper", "a"), "a.command", "lower", "p", ("b",)
    link = RackLink(*ends, True, grid, grid, 10 * MS, 5 * MS, max_lost)
    taken_ns = link.compute_taken_ns(written, is_lockstep)
    assert taken_ns + link.compute_shown_ns(read) == expected_ms * MS


def test_the_chains_of_two_racks_pass_from_the_upper_rack_to_the_lower_one() -> None:
    joined = join_brown(LOCKSTEP)
    texts = [" > ".join(map(str, chain)) for chain in joined.chains]
    assert sum("brown/trajectory > brown-servo/supervisor > " in text for text in texts) == 3
    assert "brown/modifications > brown-servo/elbow > brown-servo/arm" in texts
    assert all(chain[-1] == Station("brown-servo", "arm") for chain in joined.chains)


def test_a_path_begins_at_the_board_whose_release_the_messages_carry() -> None:
    joined = join_brown(LOCKSTEP)
    # Motions wait in a queue for any time, so a command carries the release of the trajectory.
    command = find_path(joined.list_paths("brown-servo"), "command", "brown/trajectory")
    assert command.boards[0] == "supervisor"
    status = find_path(joined.list_paths("brown"), "status", "brown-servo/arm")
    assert status.boards == ("trajectory", "planning")
    # 1 ms for each of arm and joint board, without waits on one grid.
    assert (status.first_cycle_ms, status.far_ms) == (1.0, 2.0 + 1.0)
    assert joined.list_paths("brown") != joined.list_paths()


def test_in_real_time_a_bound_is_longer_by_the_budget_of_the_link() -> None:
    lockstep, real_time = (
        find_path(join_brown(*mode).list_paths("brown"), "status", "brown-servo/arm")
        for mode in ([LOCKSTEP], [])
    )
    # 20 ms for the phases of both exchanges and 20 ms of delay.
    assert real_time.response_ms - lockstep.response_ms == pytest.approx(40.0)


def test_each_rack_of_the_cell_hears_of_the_coordinator() -> None:
    joined = join("cell", "cell/puma", "cell/k1607")
    assert {chain[0] for chain in joined.chains} == {Station("cell", "task")}
    assert {chain[-1].rack for chain in joined.chains} == {"cell-puma", "cell-k1607"}
    assert all(verdict.holds for verdict in judge_joined_racks(joined))


def test_partners_are_those_that_are_launched_and_those_that_are_named() -> None:
    assert [one.name for one in load_partners(load("brown"))] == ["brown-servo"]
    assert [one.name for one in load_partners(load("brown/servo", [LOCKSTEP]))] == ["brown"]
    assert load_partners(load("nasrem")) == []
    assert load_partners(load("brown/servo", [LOCKSTEP]))[0].is_lockstep


def test_a_goal_of_the_upper_rack_limits_the_response() -> None:
    joined = join_racks([load("brown", ["timing.response_ms=150"]), load("brown/servo")])
    lines = [*format_joined_verdicts(judge_joined_racks(joined))]
    assert lines[0] == "across racks: does not fit: 1 of 2 responses hold"
    assert lines[1].startswith("  FAILS: a command down 174 ms, a status up 283 ms; limit 150 ms")


def load_changed_servo(folder: Path, old: str, new: str) -> RackConfig:
    text = (CONFIGS / "brown" / "servo.toml").read_text()
    assert old in text
    path = folder / "servo.toml"
    path.write_text(
        text.replace('"../', '"').replace("partners =", "peers = [] #").replace(old, new)
    )
    return load(path)


def test_a_link_without_budget_is_named(tmp_path: Path) -> None:
    servo = load_changed_servo(tmp_path, "delay_ms", "max_lost = 2 #")
    with pytest.raises(
        Failure, match=r"^rack brown-servo: adapter\.lan\.import\.reference has no delay_ms"
    ) as raised:
        judge_joined_racks(join_racks([load("brown"), servo]))
    assert raised.value.status == 2


def test_racks_without_a_command_between_them_are_refused() -> None:
    with pytest.raises(Failure, match="no command passes between these racks: nasrem, brown"):
        judge_joined_racks(join("nasrem", "brown"))


def test_an_import_that_the_other_rack_does_not_export_is_named(tmp_path: Path) -> None:
    table = '[adapter.lan.export.status]\nfrom = "supervisor.status"\nrate_hz = 50\n'
    servo = load_changed_servo(tmp_path, table, "")
    with pytest.raises(ConfigError, match=r"rack brown: adapter\.lan\.import\.joints\.from"):
        join_racks([load("brown"), servo])
