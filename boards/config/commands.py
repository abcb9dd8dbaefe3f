"""What an operator's commands must agree on with the rack that they are for: every mistake of every one, at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.boards.config.classes import find_class
from rack.boards.config.schema import RackConfig
from rack.boards.errors import Mistake
from rack.boards.operating.config import CommandConfig
from rack.levels.errors import RobotError
from rack.levels.level import Executor
from rack.levels.operator import Commands, Goal, goal_names, listed
from rack.levels.tables import RobotConfig, SceneConfig

OWN_OPERATOR = "own.operator"


def commandable(config: RackConfig) -> dict[str, Commands]:
    """Return what an operator may tell each level, by board; levels that take no commands are left out."""
    found = {}
    for name, board in config.board.items():
        try:
            executor = find_class(board.executor, Executor)
        except LookupError:
            # That there is no such class is a mistake of its own, and told.
            continue
        if any(port.source == OWN_OPERATOR for port in executor.inputs.values()):
            found[name] = executor.commands
    return found


def command_mistakes(
    commands: Iterable[tuple[str, CommandConfig]], config: RackConfig, untold: frozenset[str] = frozenset()
) -> list[Mistake]:
    """Return everything wrong with commands, given with their places in a config; empty for one given live.

    `untold` are boards whose own mistakes are told already.
    """
    told = list(commands)
    known = [(place, command) for place, command in told if command.level not in untold]
    found = [mistake for place, command in known for mistake in _mistakes(place, command, config)]
    if len(told) > OPERATOR_ENTRIES:
        found.append(Mistake("command", len(told), f"more than can wait at once; permitted: {OPERATOR_ENTRIES}"))
    return found


def command_places(config: RackConfig) -> list[tuple[str, CommandConfig]]:
    """Return the commands of a config with their places in it."""
    return [(f"command[{at}]", command) for at, command in enumerate(config.command)]


def joint_ranges(config: RackConfig) -> NDArray[np.float64] | None:
    """Return the positions that joints may be sent to, (joints, 2), rad; None for a rack without an arm.

    Raises `RobotError` when the arm or its cell cannot be built.
    """
    return None if config.robot is None else _ranges(config.robot, config.scene, config.clock_ns)


@lru_cache(maxsize=4)
def _ranges(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> NDArray[np.float64]:
    from rack.levels.robot.cell import build_cell  # MuJoCo takes half a second to import: only who sends joints pays

    return build_cell(robot, scene, clock_ns).limits.position


def _mistakes(place: str, command: CommandConfig, config: RackConfig) -> Iterator[Mistake]:
    def at(key: str) -> str:
        return f"{place}.{key}" if place else key

    if command.tick is not None and command.at is not None:
        yield Mistake(at("at"), command.at, "tick is given as well; permitted: one of tick, at")
    levels = commandable(config)
    if command.level not in levels:
        why = f"no level that can be commanded; levels: {', '.join(levels) or 'none'}"
        yield Mistake(at("level"), command.level, why)
        return
    known = levels[command.level]
    if command.said not in known:
        yield Mistake(at("what"), command.what, f"'{command.level}' takes no {command.what}; it takes: {listed(known)}")
        return
    yield from _goal(at, command, known)
    if command.joints is not None and Goal.JOINTS in known[command.said]:
        yield from _joints(at("joints"), command.joints, config)
    for key in ("quaternion", "direction"):
        if getattr(command, key) is not None and not any(getattr(command, key)):
            yield Mistake(at(key), list(getattr(command, key)), "is all zero; its length must not be zero")


def _goal(at: Callable[[str], str], command: CommandConfig, known: Commands) -> Iterator[Mistake]:
    """Whether there is one goal, of a form that the level takes."""
    wanted, given = known[command.said], command.goals
    what = f"{command.what} of '{command.level}'"
    if not wanted:
        for goal in given:
            yield Mistake(at(_key(goal)), None, f"{command.what} has no goal; leave it out")
    elif len(given) != 1:
        why = "missing" if not given else f"{goal_names(given)} are given"
        yield Mistake(at("goal"), None, f"{why}; {what} has one of: {goal_names(wanted)}")
    elif given[0] not in wanted:
        yield Mistake(at(_key(given[0])), None, f"no goal for {what}; permitted: {goal_names(wanted)}")
    elif command.position is None and given[0] in (Goal.POSE, Goal.DIRECTION):
        yield Mistake(at("position"), None, "missing; where the tool is to be, m")
    elif command.quaternion is not None and command.direction is not None:
        yield Mistake(at("direction"), list(command.direction), "quaternion is given as well; permitted: one of both")


def _key(goal: Goal) -> str:
    return {Goal.POSE: "quaternion", Goal.DIRECTION: "position"}.get(goal, goal.name.lower())


def _joints(place: str, joints: tuple[float, ...], config: RackConfig) -> Iterator[Mistake]:
    try:
        robot, ranges = config.robot, joint_ranges(config)
    except RobotError:
        # That the cell cannot be built is a mistake of its own, and told.
        return
    if robot is None or ranges is None:
        yield Mistake(place, list(joints), "the rack has no arm")
    elif len(joints) != len(robot.joints):
        why = f"{len(joints)} values; one a joint makes {len(robot.joints)}: {', '.join(robot.joints)}"
        yield Mistake(place, list(joints), why)
    else:
        for name, value, (low, high) in zip(robot.joints, joints, ranges, strict=True):
            if not low <= value <= high:
                yield Mistake(place, value, f"joint '{name}' cannot be there; permitted: {low:g} to {high:g} rad")
