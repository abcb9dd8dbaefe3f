"""A rack as plain data: its chains, its longest cycles, and the verdicts on the paper's figure
3."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rack.backplane.words import Scheduler
from rack.boards.timing.chains import format_names
from rack.boards.timing.forecast import NO_BUDGET, Forecast
from rack.boards.timing.level import BoardTiming, StandbyPlace
from rack.boards.timing.rack import RackTiming
from rack.boards.timing.tasks import Budget, Part, TimedTask, Unit
from rack.boards.timing.verdicts import evaluate_rack

MS = 1_000_000
CLOCK = TimedTask("clock", "clock", "clock", 0, 90, 2 * MS, ())
FIGURE_3 = BoardTiming(
    name="level",
    above=(),
    coupling="tight",
    every=3,
    due=3,
    within_cycles=3,
    core=1,
    priority=80,
    planner_core=1,
    planner_priority=0,
    has_planner=True,
    is_critical=True,
    budget=Budget(read_ns=MS, process_ns=2 * MS, write_ns=MS, plan_ns=6 * MS, update_ns=MS),
    plan_within_ns=None,
    queues=(),
    phase=0,
    scheduler=Scheduler.FIXED_PRIORITY,
    is_urgent=False,
    standbys=(),
    reads={},
)


def rack(*boards: BoardTiming, goal_ns: float | None = None) -> RackTiming:
    named = {board.name: board for board in boards}
    return RackTiming(False, 1.0, 2 * MS, CLOCK, named, 0, 0.2, goal_ns, {}, None)


def board(name: str, every: int, above: str = "") -> BoardTiming:
    return replace(FIGURE_3, name=name, every=every, above=tuple(above.split()), budget=None)


def test_figure_3_fails_as_in_the_paper_from_plain_data() -> None:
    failing = {(v.equation, v.subject) for v in evaluate_rack(rack(FIGURE_3)) if not v.holds}
    assert failing == {("3.8", "level"), ("response time", "level.planner"), ("load", "core 1")}
    # The paper's own way out: cycles of 8 ms, figure 2.
    longer = rack(FIGURE_3).replace_board("level", every=4, within_cycles=2)
    assert all(verdict.holds for verdict in evaluate_rack(longer))


def test_a_standby_is_one_more_executor_on_its_core() -> None:
    place = StandbyPlace("level.standby", 0, 70)
    alone = rack(FIGURE_3)
    doubled = alone.replace_board("level", standbys=(place,))
    executor, standby = (
        next(task for task in doubled.tasks if task.name == name) for name in ("level", place.name)
    )
    assert standby == replace(executor, name=place.name, core=0, priority=70)
    assert doubled.cores[place.name] == 0
    assert doubled.loads == alone.loads | {0: standby.cost_ns / standby.every_ns}


def test_every_chain_runs_from_a_highest_board_to_a_lowest() -> None:
    timing = rack(board("top", 40), board("a", 4, "top"), board("b", 60, "top"), board("alone", 7))
    assert timing.chains == (("top", "a"), ("top", "b"))
    assert timing.hierarchy.chains == (("top", "b"),)
    assert timing.longest_cycles == {"top": 60, "a": 60, "b": 60, "alone": 7}


@pytest.mark.parametrize(
    ("cycles", "ticks"),
    [
        ([8], 8),
        ([400, 100, 8, 1], 509 + 4),  # 100 and 8 meet every 4 ticks only
        ([1, 8, 100, 400], 509 + 7 + 96 + 300),
    ],
)
def test_response_is_the_sum_of_the_cycles_and_of_the_waits_for_the_grid(
    cycles: list[int], ticks: int
) -> None:
    names = [f"b{cycle}" for cycle in cycles]
    boards = [board(name, cycle) for name, cycle in zip(names, cycles, strict=True)]
    assert rack(*boards).compute_response_ticks(names) == ticks


JOINTS = tuple(f"joint{k}" for k in range(1, 7))


def arm_of(*joints: str) -> RackTiming:
    """A board a joint between a trajectory level, which has a planner's board above it, and the
    board of the arm."""
    names = " ".join(joints)
    boards = board("plan", 200), board("path", 20, "plan"), board("arm", 2, names)
    return rack(*boards, *(board(name, 4, "path") for name in joints), board("alone", 500))


def test_one_board_per_joint_forms_one_group_of_parallel_chains() -> None:
    timing = arm_of(*JOINTS)
    assert timing.chains == tuple(("plan", "path", joint, "arm") for joint in JOINTS)
    (together,) = timing.chain_groups
    assert timing.hierarchy == together
    assert together.text == "plan > path > joint1 ... joint6 > arm"
    assert timing.ranks == (("plan",), ("path",), JOINTS, ("arm",))
    assert set(timing.longest_cycles.values()) == {200, 500}
    # 200 + 20 + 4 + 2 ticks of 2 ms, for all joints in one line.
    (eq_3_3,) = [verdict for verdict in evaluate_rack(timing) if verdict.equation == "3.3"]
    assert (eq_3_3.subject, eq_3_3.left) == ("system", 226 * 2 * MS)


def test_a_goal_is_divided_by_the_levels_of_the_longest_chain_through_a_board() -> None:
    boards = [board("top", 40), board("middle", 8, "top"), board("low", 4, "middle top")]
    found = rack(*boards, board("alone", 7), goal_ns=60 * 2.0 * MS).longest_cycles
    assert found == {"top": 20, "middle": 20, "low": 20, "alone": 7}


def test_a_forecast_names_the_planners_that_it_cannot_judge() -> None:
    assert FIGURE_3.budget is not None
    silent = replace(
        FIGURE_3, name="silent", budget=replace(FIGURE_3.budget, plan_ns=0), core=2, planner_core=2
    )
    plain = replace(silent, name="plain", has_planner=False, core=3)
    found = Forecast.from_rack(rack(FIGURE_3, silent, plain, board("unknown", 4))).uncounted
    assert found.keys() - {CLOCK.name} == {"silent.planner", "unknown", "unknown.planner"}
    assert {why for name, why in found.items() if name != CLOCK.name} == {NO_BUDGET}
    assert not Forecast.from_rack(rack(FIGURE_3, plain)).uncounted.keys() - {CLOCK.name}
    # Without any budget only the system is judged.
    forecast = Forecast.from_rack(rack(board("top", 40), board("a", 4, "top")))
    assert {verdict.subject for verdict in forecast.verdicts} == {"system"}
    assert {"top", "a"} <= forecast.uncounted.keys()


def test_a_forecast_notes_exactly_what_it_leaves_out() -> None:
    fast = TimedTask("clock", "clock", "clock", 0, 90, 2 * MS, (Part(Unit.PROCESS, MS // 10),))
    counted = replace(rack(FIGURE_3), clock=fast)
    ordinary = replace(FIGURE_3, planner_priority=70)
    assert Forecast.from_rack(replace(counted, boards={"level": ordinary})).notes == ()
    notes = Forecast.from_rack(replace(counted, is_lockstep=True, speed=2.0), has_cores=False).notes
    expected = "in lockstep", "times are wall-clock times: speed 2", "cores are those in the config"
    assert len(notes) == len(expected)
    assert all(note.startswith(start) for note, start in zip(notes, expected, strict=True))
    queued = arm_of(*JOINTS).replace_board("path", queues=("plan.requests",))
    assert Forecast.from_rack(queued).notes[0] == (
        "the system response assumes that these queues are empty: plan.requests"
    )
    # Without a budget there is nothing to say about times.
    bare = replace(rack(board("bare", 4)), is_lockstep=True, speed=2.0)
    assert Forecast.from_rack(bare, has_cores=False).notes == ()
    # Two ordinary tasks that compute share a core; one has it to itself.
    both = replace(counted, boards={"level": replace(FIGURE_3, priority=0, planner_priority=0)})
    assert "ordinary scheduling" in Forecast.from_rack(both).notes[-1]


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (("joint1", "joint2", "joint3"), "joint1 ... joint3"),
        (("joint9", "joint10", "joint11"), "joint9 ... joint11"),
        (("j1.planner", "j2.planner", "j3.planner"), "j1.planner ... j3.planner"),
        (("joint1", "joint2"), "joint1, joint2"),
        (("joint1", "joint2", "joint4"), "joint1, joint2, joint4"),
        (("joint2", "joint1", "joint3"), "joint2, joint1, joint3"),
        (("a1", "b2", "c3"), "a1, b2, c3"),
        (("joint1", "joint2", "joint3", "arm"), "joint1 ... joint3, arm"),
        (("servo",), "servo"),
        ((), ""),
    ],
)
def test_numbered_names_are_shortened_only_if_none_is_left_out(
    names: tuple[str, ...], text: str
) -> None:
    assert format_names(names) == text
