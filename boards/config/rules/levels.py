"""What the levels' classes demand of their boards, and what arm and scene must be for them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from pydantic import ValidationError

from rack.backplane.address_map import AddressMap
from rack.backplane.errors import MailboxError
from rack.backplane.layout import Layout
from rack.backplane.regular_file import check_regular_file
from rack.boards.config.cell import cell_sizes
from rack.boards.config.connections import Wiring
from rack.boards.config.mistakes import mistakes_of, repeated
from rack.boards.errors import Mistake, Mistakes
from rack.levels.errors import RobotError
from rack.levels.level import Executor, LevelContext

MAX_SEGMENT_BYTES = 2**30
MAX_MODEL_BYTES = 2**30


def params(wiring: Wiring) -> Mistakes:
    """Check each board's parameters against the declarations of its executor's and planner's
    classes.
    """
    for table, kind in wiring.params:
        tables, _, board = table.partition(".")
        given = getattr(wiring.config, tables)[board].params
        try:
            kind.model_validate(given)
        except ValidationError as error:
            yield from mistakes_of(error, kind, given, f"{table}.params")


def programs(wiring: Wiring) -> Mistakes:
    """Check `[task]` against the programs declared by the levels' classes."""
    config = wiring.config
    for kind in wiring.programs:
        try:
            program = kind.model_validate(config.task)
        except ValidationError as error:
            yield from mistakes_of(error, kind, config.task, "task")
        else:
            for key, value, why in program.misfits(config.robot, config.scene):
                yield Mistake(f"task.{key}", value, why)


def sizes(wiring: Wiring, sizes: Mapping[str, int]) -> Mistakes:
    """Check that the rack knows each size that a message needs."""
    for mailbox, (ports, output) in wiring.writers.items():
        try:
            output.message.message_type.dtype(sizes)
        except MailboxError as error:
            yield Mistake(f"mailbox {mailbox}", ports.task, str(error))


def memory(layout: Layout) -> Mistakes:
    """Check the size of the segment, and name the largest mailbox."""
    size = AddressMap(layout).size
    if size > MAX_SEGMENT_BYTES:
        box = max(layout.mailboxes, key=lambda mailbox: mailbox.depth * mailbox.size)
        why = (
            f"{box.depth} messages are kept for its slowest reader, so the segment needs {size}"
            " bytes"
        )
        advice = f"permitted: {MAX_SEGMENT_BYTES}; shorten cycles or within_cycles"
        yield Mistake(f"mailbox {box.name}", None, f"{why}; {advice}")


def neighbours(wiring: Wiring, contexts: Mapping[str, LevelContext]) -> Mistakes:
    """Ask each level whether its neighbours suit it; `contexts` by board, without boards that have
    mistakes.
    """
    for ports in wiring.tasks:
        board = wiring.config.board[ports.place.board]
        asked = {ports.task, *board.above, *board.below}
        if issubclass(ports.kind, Executor) and asked <= contexts.keys():
            above, below = (
                [contexts[other] for other in others] for others in (board.above, board.below)
            )
            for key, value, why in ports.kind.misfits(contexts[ports.task], above, below):
                yield Mistake(f"board.{ports.task}.{key}", value, why)


def scene(wiring: Wiring) -> Mistakes:
    """Check the names of objects and obstacles."""
    scene = wiring.config.scene
    for kind, key, those in (
        ("motion", "body", "obstacles"),
        ("push", "body", "objects"),
        ("goal", "object", "objects"),
    ):
        for at, entry in enumerate(getattr(scene, kind)):
            name = getattr(entry, key)
            known = getattr(scene, those)
            if name not in known:
                why = f"no such {those[:-1]}; scene.{those}: {', '.join(known) or 'none'}"
                yield Mistake(f"scene.{kind}[{at}].{key}", name, why)
    yield from repeated("scene.objects and scene.obstacles", scene.bodies)


def robot(wiring: Wiring) -> Mistakes:
    """Check that the model is there, and that each list has a value per joint."""
    robot = wiring.config.robot
    if robot is None:
        return
    try:
        check_regular_file(robot.model, MAX_MODEL_BYTES)
    except OSError as error:
        yield Mistake("robot.model", str(robot.model), f"cannot be read: {error.strerror}")
    for key, values, why in robot.misfits():
        yield Mistake(f"robot.{key}", values, why)
    if robot.hand is not None and robot.interface != "torque":
        why = "tendons of a hand take tensions; permitted: torque"
        yield Mistake("robot.interface", robot.interface, why)
    yield from repeated("robot.joints", robot.joints)


def cell(wiring: Wiring) -> Mistakes:
    """Check that arm and scene fit the model. If a table of theirs has mistakes of its own, only
    names are checked.
    """
    robot_table, scene_table = wiring.config.robot, wiring.config.scene
    found: list[str] = []
    if robot_table is None:
        return
    if not wiring.broken & {"robot", "scene"} and not [*robot(wiring), *scene(wiring)]:
        try:
            cell_sizes(wiring.config)
            return
        except RobotError as error:
            found = [str(error)]
    from rack.levels.robot.lookup import unknown_names

    # Every name that the model lacks; none are known if the model cannot be read.
    with suppress(RobotError):
        found = [*unknown_names(robot_table, scene_table)] or found
    for line in found:
        place, colon, why = line.partition(": ")
        if colon and place.startswith(("robot", "scene")):
            yield Mistake(place, None, why)
        else:
            yield Mistake("robot", None, line)
