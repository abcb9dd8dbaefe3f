"""Planning of actions as elemental moves, in the quickest feasible way."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import numpy as np

from rack.levels.algebra import Array
from rack.levels.errors import Refused
from rack.levels.messages import Error, Verb
from rack.levels.planning.ik import MAX_RESTARTS
from rack.levels.planning.motion_planner import MAX_DEVIATION_M, MotionPlanner, format_position
from rack.levels.planning.moves import Situation
from rack.levels.planning.pose import Pose, build_pointing_quaternion, make_pose
from rack.levels.tables import SceneConfig
from rack.levels.task.grasps import SLIP_M, find_goals, find_grasps, find_standing_pose, is_leaning
from rack.levels.task.program import DOWN, Goto, Home, TaskConfig, Transfer
from rack.levels.task.rehearsal import Rehearsal

Option = TypeVar("Option")

TURN_COUNT = 8
"""Number of turns about the tool's z axis that are tried if only its direction is given."""
MAX_WAYS = 16
"""Maximum number of ways to do an action for which all motions are planned."""
LEANING_RESTARTS = 20
"""Number of random starts of the inverse kinematics for a tool that leans.

Many of its poses are out of reach. With this number, 80 of 7,100 reachable poses were not found, in
layouts that the PUMA refuses.
"""
HALVINGS = 7
"""Number of bisections to find a reachable place on the way to an unreachable one."""


class Spot(NamedTuple):
    """Pose of the tool at an object."""

    tool: Pose
    above: Array  # a configuration with the tool straight above that pose, (joints,), rad


class Way(NamedTuple):
    """Spots at which a transfer takes the object and puts it down."""

    take: Spot
    put: Spot


def rehearse(program: TaskConfig, scene: SceneConfig, start: Rehearsal) -> Rehearsal:
    """Plan a whole program as moves.

    Args:
        program: The program.
        scene: The `[scene]` table.
        start: Rehearsal without moves, at the start of the program.

    Returns:
        The rehearsal after the last action.

    Raises:
        Refused: An action cannot be done. The reason names the position, and a possible
            alternative.
    """
    rehearsal = start
    for k, action in enumerate(program.action):
        if isinstance(action, Transfer):
            rehearsal = rehearse_transfer(rehearsal, k, action, scene)
            continue
        with _label_refusals(k, str(action)):
            if isinstance(action, Goto):
                rehearsal = rehearse_goto(rehearsal, k, action)
            elif isinstance(action, Home):
                rehearsal = rehearsal.add_move(
                    k, Verb.MOVE_JOINTS, joints=rehearsal.motion.cell.home
                )
    return rehearsal


@contextmanager
def _label_refusals(k: int, step: str) -> Iterator[None]:
    """Prefix a refusal that is raised in the block with `step`, and add the action's number `k`."""
    try:
        yield
    except Refused as refused:
        raise Refused(refused.code, f"{step}: {refused}", k) from refused


def rehearse_goto(rehearsal: Rehearsal, k: int, action: Goto) -> Rehearsal:
    """Return the rehearsal after a goto.

    Args:
        rehearsal: Rehearsal of the actions before it.
        k: Number of the action.
        action: The goto.

    Raises:
        Refused: The goal cannot be reached.
    """
    if action.joints is not None:
        return rehearsal.add_move(k, Verb.MOVE_JOINTS, joints=np.array(action.joints))
    assert action.position is not None, "a goto has joints or a position"
    motion = rehearsal.motion
    rehearsal.situation.apply_to(motion.checker, None)
    if action.direction == "any":
        place = make_pose(action.position, build_pointing_quaternion(DOWN))
        reachable = motion.ik.find_solutions(place, rehearsal.q, match_orientation=False)
        tools = [motion.ik.compute_tool_pose(q) for q in reachable] or [place]
    elif action.quaternion is not None:
        tools = [make_pose(action.position, action.quaternion)]
    else:
        turns = np.arange(TURN_COUNT) * 2.0 * np.pi / TURN_COUNT
        tools = [
            make_pose(action.position, build_pointing_quaternion(action.direction or DOWN, turn))
            for turn in turns
        ]
    ends = [
        (tool, q)
        for tool in tools
        for q in motion.ik.find_solutions(tool, rehearsal.q)
        if motion.checker.is_free(q)
    ]
    if not ends:
        raise _explain_unreachable(motion, tools, rehearsal.q)
    ends.sort(key=lambda end: motion.ik.compute_travel_time(rehearsal.q, end[1]))
    return _rehearse_first(
        ends[:MAX_WAYS], lambda end: rehearsal.add_move(k, Verb.MOVE, tool=end[0], joints=end[1])
    )


def rehearse_transfer(
    rehearsal: Rehearsal, k: int, action: Transfer, scene: SceneConfig
) -> Rehearsal:
    """Return the rehearsal after a transfer.

    Args:
        rehearsal: Rehearsal of the actions before it.
        k: Number of the action.
        action: The transfer.
        scene: The `[scene]` table.

    Raises:
        Refused: The transfer cannot be done. The reason names the step, pick or place.
    """
    planner = TransferPlanner(rehearsal, scene.objects.index(action.object), action.lift)
    pick = f"pick {action.object}"
    place = f"place {action.object} at [{', '.join(f'{value:.4g}' for value in action.to)}]"
    with _label_refusals(k, place):
        situation = rehearsal.situation
        row = planner.row
        cell = rehearsal.motion.cell
        data = cell.build_start_data()
        standing_goals = [
            [
                find_standing_pose(cell, data, row, situation.with_body_at(row, goal))
                for goal in group
            ]
            for group in find_goals(action, situation.object_pose(row), cell)
        ]

    def pair_pick_spots_with_goals() -> Iterator[tuple[list[Spot], list[Pose]]]:
        """Yield each pair of a group of pick spots and a group of goals, sorted by pick group."""
        with _label_refusals(k, pick):
            for takes in planner.find_pick_spots():
                yield from ((takes, group) for group in standing_goals)

    def rehearse_pair(pair: tuple[list[Spot], list[Pose]]) -> Rehearsal:
        """Rehearse the quickest feasible transfer from the pick spots to the goals."""
        with _label_refusals(k, place):
            ways = planner.find_ways(*pair)
        return _rehearse_first(ways[:MAX_WAYS], rehearse_way)

    def rehearse_way(way: Way) -> Rehearsal:
        """Rehearse the moves that pick the object up and put it down."""
        with _label_refusals(k, pick):
            taken = planner.rehearse_moves(rehearsal, k, way.take, Verb.GRASP)
        with _label_refusals(k, place):
            return planner.rehearse_moves(taken, k, way.put, Verb.RELEASE)

    return _rehearse_first(pair_pick_spots_with_goals(), rehearse_pair)


class TransferPlanner(NamedTuple):
    """Plans one transfer of an object.

    The tool moves straight down to the object and straight up again.
    """

    start: Rehearsal  # before the transfer
    row: int  # row of the object in the world model
    lift: float  # height of the straight motions, m

    def find_pick_spots(self) -> Iterator[list[Spot]]:
        """Yield the spots at which the object can be taken and held, one list per group of grasps.

        The groups are in the order of `find_grasps`. Groups without a spot are left out.

        Raises:
            Refused: No group has a spot. The refusal is from the first group.
        """
        start = self.start
        refusal: Refused | None = None
        is_taken = False
        jaw = start.motion.fixed_jaw
        seen = start.situation.object_pose(self.row)
        for tools in find_grasps(start.motion.cell, start.situation, self.row):
            if jaw is not None:
                tools = [jaw.move_beside(tool, self.row, seen) for tool in tools]
            takes = [
                spot
                for tool in tools
                for spot in self._find_spots(tool, start.situation, grasps=True)
            ]
            try:
                if takes:
                    yield self._select_holdable(takes)
                    is_taken = True
                elif refusal is None:
                    refusal = self._explain_unreachable(tools)
            except Refused as refused:
                refusal = refusal or refused
        if not is_taken:
            assert refusal is not None, "there is at least one height"
            raise refusal

    def find_ways(self, takes: list[Spot], standing_goals: list[Pose]) -> list[Way]:
        """Return pairs of a pick spot and a place spot, sorted by travel time.

        Args:
            takes: Spots at which the object can be taken.
            standing_goals: Poses in which the object may be put down.

        Raises:
            Refused: No pair exists, because no place spot can be reached.
        """
        situation = self.start.situation
        start_q = self.start.q
        ways: list[Way] = []
        puts: list[tuple[Pose, list[Spot]]] = []
        for take in takes:
            grip = take.tool.inverse() @ situation.object_pose(self.row)
            slip_m = SLIP_M if is_leaning(take.tool) else 0.0
            for goal in standing_goals:
                tool = goal.raise_by(slip_m) @ grip.inverse()
                spots = next((spots for known, spots in puts if known.is_near(tool)), None)
                if spots is None:
                    spots = self._find_spots(tool, situation.with_object_held(self.row, grip))
                    puts.append((tool, spots))
                ways += [Way(take, put) for put in spots]
        if not ways:
            raise self._explain_unreachable([tool for tool, _ in puts])
        time_s = self.start.motion.ik.compute_travel_time
        return sorted(
            ways,
            key=lambda way: time_s(start_q, way.take.above) + time_s(way.take.above, way.put.above),
        )

    def rehearse_moves(self, rehearsal: Rehearsal, k: int, spot: Spot, verb: Verb) -> Rehearsal:
        """Return the rehearsal after the four moves of a grasp or a release.

        Args:
            rehearsal: Rehearsal of the moves before them.
            k: Number of the action.
            spot: Spot at which the object is taken or put down.
            verb: GRASP or RELEASE.

        Raises:
            Refused: A move cannot be done.
        """
        above = spot.tool.raise_by(self.lift)
        row = self.row
        over = None if verb is Verb.GRASP else row
        rehearsal = rehearsal.add_move(k, Verb.MOVE, tool=above, row=over, joints=spot.above)
        rehearsal = rehearsal.add_move(k, Verb.APPROACH, tool=spot.tool, row=row)
        rehearsal = rehearsal.add_move(k, verb, tool=spot.tool, row=row)
        return rehearsal.add_move(k, Verb.DEPART, tool=above, row=row)

    def _find_spots(self, tool: Pose, situation: Situation, grasps: bool = False) -> list[Spot]:
        """Return spots at tool pose `tool` to which the arm can descend without collision.

        If `grasps` is True, the gripper must also be able to close there without collision.
        """
        motion = self.start.motion
        situation.apply_to(motion.checker, None)
        restarts = LEANING_RESTARTS if is_leaning(tool) else MAX_RESTARTS
        over = tool.raise_by(self.lift)
        above = motion.ik.find_solutions(over, self.start.q, restarts=restarts)
        above = [q for q in above if motion.checker.is_free(q)]
        situation.apply_to(motion.checker, self.row)
        ends = [(q, motion.ik.find_configuration(tool, q)) for q in above]
        free = [(q, end) for q, end in ends if end is not None and motion.checker.is_free(end)]
        if grasps and motion.checker.longest_opening is not None:
            closed = situation.with_object_held(
                self.row, tool.inverse() @ situation.object_pose(self.row)
            )
            closed.apply_to(motion.checker, self.row)
            free = [(q, end) for q, end in free if motion.checker.is_free(end, MAX_DEVIATION_M)]
        return [Spot(tool, q) for q, _ in free]

    def _select_holdable(self, takes: list[Spot]) -> list[Spot]:
        """Return the spots at which gripper and motors can hold the object.

        Raises:
            Refused: The object can be held at none of the spots. The refusal is for the first spot.
        """
        payloads = self.start.motion.payloads
        seen = self.start.situation.object_pose(self.row)
        held: list[Spot] = []
        refusals: list[Refused] = []
        for take in takes:
            grip = take.tool.inverse() @ seen
            try:
                payloads.check_grip(self.row, grip)
                payloads.check_motors(self.row, grip, take.above[None, :])
                held.append(take)
            except Refused as refused:
                refusals.append(refused)
        if not held:
            raise refusals[0]
        return held

    def _explain_unreachable(self, tools: list[Pose]) -> Refused:
        """Return the refusal for tool poses that cannot be reached from above without collision."""
        places = [place for tool in tools for place in (tool, tool.raise_by(self.lift))]
        return _explain_unreachable(self.start.motion, places, self.start.q)


def _rehearse_first(options: Iterable[Option], do: Callable[[Option], Rehearsal]) -> Rehearsal:
    """Call `do` with one option after another until one succeeds, and return its rehearsal.

    Raises:
        Refused: No option succeeds. The refusal is for the first option.
    """
    refusals: list[Refused] = []
    for option in options:
        try:
            return do(option)
        except Refused as refused:
            refusals.append(refused)
    raise refusals[0]


def _explain_unreachable(motion: MotionPlanner, tools: list[Pose], here: Array) -> Refused:
    """Return the refusal for tool poses that cannot be reached from `here` without collision."""
    beyond: Pose | None = None
    for tool in tools:
        reachable = motion.ik.find_solutions(tool, here)
        if why := next(filter(None, map(motion.checker.describe_collision, reachable)), ""):
            return Refused(Error.NO_PATH, why)
        if beyond is None and not reachable:
            beyond = tool
    end = beyond or tools[0]
    out_of_reach = f"out of reach: {format_position(end)}; in reach"
    if motion.ik.find_solutions(end, here, match_orientation=False):
        return Refused(Error.UNREACHABLE, f"{out_of_reach} in another orientation")
    begin = motion.ik.compute_tool_pose(here)
    low = 0.0
    high = 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        reached = bool(
            motion.ik.find_solutions(
                Pose(begin.interpolate_to(end, middle).position, end.quaternion), here
            )
        )
        low, high = (middle, high) if reached else (low, middle)
    in_reach = begin.interpolate_to(end, low)
    return Refused(Error.UNREACHABLE, f"{out_of_reach}: {format_position(in_reach)}")
