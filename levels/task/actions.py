"""Actions as elemental moves: of the ways to do an action, the quickest that can be gone to its end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from rack.levels.errors import Refused
from rack.levels.messages import Error, Verb
from rack.levels.planning.motion import MotionPlanner, at
from rack.levels.planning.pose import Pose, pointing, pose
from rack.levels.planning.situation import Situation
from rack.levels.tables import SceneConfig
from rack.levels.task.grasps import DOWN, goals, grasps, standing
from rack.levels.task.program import Goto, Home, TaskConfig, Transfer
from rack.levels.task.rehearsal import Rehearsal

Array = NDArray[np.float64]
Option = TypeVar("Option")

TURNS = 8
"""Turns about the tool's z axis that are tried where only its direction is given."""
WAYS = 16
"""Ways to do an action that are tried to their end."""
HALVINGS = 7
"""Halvings in the search for what is reachable on the way to a place that is not."""


class Spot(NamedTuple):
    """A pose of the tool at an object, and a configuration (joints,), rad, straight above it."""

    tool: Pose
    above: Array


class Way(NamedTuple):
    """Where a transfer takes the object and where it puts it down."""

    take: Spot
    put: Spot


def rehearse(program: TaskConfig, scene: SceneConfig, start: Rehearsal) -> Rehearsal:
    """Return the whole program as moves, rehearsed. Raises `Refused` that names action, place and what is possible."""
    rehearsal = start
    for k, action in enumerate(program.action):
        if isinstance(action, Transfer):
            rehearsal = transfer(rehearsal, k, action, scene)
            continue
        with _naming(f"action {k}, {action}"):
            if isinstance(action, Goto):
                rehearsal = goto(rehearsal, k, action)
            elif isinstance(action, Home):
                rehearsal = rehearsal.then(k, Verb.MOVE_JOINTS, joints=rehearsal.motion.cell.home)
    return rehearsal


@contextmanager
def _naming(what: str) -> Iterator[None]:
    """Say in a refusal what was refused."""
    try:
        yield
    except Refused as refused:
        raise Refused(refused.code, f"{what}: {refused}") from refused


def goto(rehearsal: Rehearsal, k: int, action: Goto) -> Rehearsal:
    """Return the rehearsal behind a goto. Raises `Refused`."""
    if action.joints is not None:
        return rehearsal.then(k, Verb.MOVE_JOINTS, joints=np.array(action.joints))
    assert action.position is not None, "a goto has joints or a position"
    if action.quaternion is not None:
        tools = [pose(action.position, action.quaternion)]
    else:
        turns = np.arange(TURNS) * 2.0 * np.pi / TURNS
        tools = [pose(action.position, pointing(action.direction or DOWN, turn)) for turn in turns]
    motion = rehearsal.motion
    rehearsal.situation.lay_out(motion.checker, None)
    ends = [(tool, q) for tool in tools for q in motion.ik.solutions(tool, rehearsal.q, motion.checker.free)]
    if not ends:
        raise _nothing_at(motion, tools, rehearsal.q)
    ends.sort(key=lambda end: motion.ik.time_between(rehearsal.q, end[1]))
    return _first(ends[:WAYS], lambda end: rehearsal.then(k, Verb.MOVE, end[0], joints=end[1]))


def transfer(rehearsal: Rehearsal, k: int, action: Transfer, scene: SceneConfig) -> Rehearsal:
    """Return the rehearsal behind a transfer. Raises `Refused` that says whether it is to pick or to place."""
    row = scene.objects.index(action.object)
    pick = f"action {k}, pick {action.object}"
    place = f"action {k}, place {action.object} at {list(action.to)}"
    with _naming(place):
        standing_goals = [
            standing(rehearsal.motion.cell, rehearsal.situation, action.object, row, goal)
            for goal in goals(action, rehearsal.situation.object_pose(row))
        ]
    with _naming(pick):
        takes = _takes(rehearsal, row, action.lift)
    with _naming(place):
        ways = _ways(rehearsal, row, takes, standing_goals, action.lift)

    def transferred(way: Way) -> Rehearsal:
        with _naming(pick):
            taken = _moved(rehearsal, k, row, way.take, action.lift, Verb.GRASP)
        with _naming(place):
            return _moved(taken, k, row, way.put, action.lift, Verb.RELEASE)

    return _first(ways[:WAYS], transferred)


def _moved(rehearsal: Rehearsal, k: int, row: int, spot: Spot, lift: float, verb: Verb) -> Rehearsal:
    """Return the rehearsal behind the four moves of a grasp or a release. Raises `Refused`."""
    above = spot.tool.raised(lift)
    rehearsal = rehearsal.then(k, Verb.MOVE, above, None if verb is Verb.GRASP else row, spot.above)
    rehearsal = rehearsal.then(k, Verb.APPROACH, spot.tool, row)
    rehearsal = rehearsal.then(k, verb, spot.tool, row)
    return rehearsal.then(k, Verb.DEPART, above, row)


def _ways(rehearsal: Rehearsal, row: int, takes: list[Spot], standing_goals: list[Pose], lift: float) -> list[Way]:
    """Return ways to do a transfer, the quickest to move first. Raises `Refused` when there is none."""
    motion, situation, here = rehearsal.motion, rehearsal.situation, rehearsal.q
    seen = situation.object_pose(row)
    ways: list[Way] = []
    puts: list[tuple[Pose, list[Spot]]] = []
    for take in takes:
        grip = take.tool.inverse() @ seen
        for goal in standing_goals:
            tool = goal @ grip.inverse()
            same = next((spots for known, spots in puts if known.is_near(tool)), None)
            if same is None:
                same = _spots(motion, situation.holding(row, grip), row, tool, here, lift)
                puts.append((tool, same))
            ways += [Way(take, put) for put in same]
    if not ways:
        raise _nothing_at(motion, [place for tool, _ in puts for place in (tool, tool.raised(lift))], here)
    pace = motion.ik.time_between
    return sorted(ways, key=lambda way: pace(here, way.take.above) + pace(way.take.above, way.put.above))


def _takes(rehearsal: Rehearsal, row: int, lift: float) -> list[Spot]:
    """Return where object `row` can be taken and held, at the lowest height at which it can. Raises `Refused`."""
    motion, situation, here = rehearsal.motion, rehearsal.situation, rehearsal.q
    refusal: Refused | None = None
    for tools in grasps(motion.cell, situation, row):
        takes = [spot for tool in tools for spot in _spots(motion, situation, row, tool, here, lift)]
        if takes:
            return _held(motion, situation, row, takes)
        refusal = refusal or _nothing_at(motion, [place for t in tools for place in (t, t.raised(lift))], here)
        if refusal.code == Error.UNREACHABLE:
            break
    assert refusal is not None, "there is at least one height"
    raise refusal


def _held(motion: MotionPlanner, situation: Situation, row: int, takes: list[Spot]) -> list[Spot]:
    """Return where gripper and motors can hold object `row`. Raises the `Refused` of the first spot when none is."""
    held: list[Spot] = []
    refusals: list[Refused] = []
    for take in takes:
        grip = take.tool.inverse() @ situation.object_pose(row)
        try:
            motion.payloads.check_grip(row, grip)
            motion.payloads.check_motors(row, grip, take.above[None, :])
            held.append(take)
        except Refused as refused:
            refusals.append(refused)
    if not held:
        raise refusals[0]
    return held


def _spots(motion: MotionPlanner, situation: Situation, row: int, tool: Pose, here: Array, lift: float) -> list[Spot]:
    """Return the free configurations above `tool` from which the arm can come down to it."""
    situation.lay_out(motion.checker, None)
    above = motion.ik.solutions(tool.raised(lift), here, motion.checker.free)
    situation.lay_out(motion.checker, row)
    ends = [(q, motion.ik.reach(tool, q)) for q in above]
    return [Spot(tool, q) for q, end in ends if end is not None and motion.checker.free(end)]


def _first(options: Iterable[Option], do: Callable[[Option], Rehearsal]) -> Rehearsal:
    """Return the first rehearsal that succeeds. Raises the `Refused` of the first option when none does."""
    refusals: list[Refused] = []
    for option in options:
        try:
            return do(option)
        except Refused as refused:
            refusals.append(refused)
    raise refusals[0]


def _nothing_at(motion: MotionPlanner, tools: list[Pose], here: Array) -> Refused:
    """Return the refusal for poses of which the arm reaches none, or none freely."""
    beyond: Pose | None = None
    for tool in tools:
        reachable = motion.ik.reachable(tool, here)
        if why := next(filter(None, map(motion.checker.why, reachable)), ""):
            return Refused(Error.NO_PATH, why)
        beyond = beyond or (tool if not reachable else None)
    begin, end = motion.ik.tool_at(here), beyond or tools[0]
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        reached = bool(motion.ik.reachable(Pose(begin.towards(end, middle).position, end.quaternion), here))
        low, high = (middle, high) if reached else (low, middle)
    return Refused(Error.UNREACHABLE, f"out of reach: {at(end)}; in reach: {at(begin.towards(end, low))}")
