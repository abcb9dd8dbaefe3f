"""Rules for the parameters and programs of levels, for arm and scene, and for memory."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from pydantic import ValidationError

from rack.backplane.address_map import AddressMap
from rack.backplane.errors import MailboxError
from rack.backplane.layout import Layout
from rack.backplane.regular_file import check_regular_file
from rack.boards.config.cell import compute_cell_sizes
from rack.boards.config.connections import Wiring
from rack.boards.config.mistakes import convert_errors, report_repeated_names
from rack.boards.errors import Mistake, Mistakes
from rack.levels.errors import RobotError
from rack.levels.level import Executor, LevelContext

MAX_SEGMENT_BYTES = 2**30
MAX_MODEL_BYTES = 2**30


def check_params(wiring: Wiring) -> Mistakes:
    """Check that each board's parameters are valid for the classes of its level."""
    for table, kind in wiring.params:
        tables, _, board = table.partition(".")
        values = getattr(wiring.config, tables)[board].params
        try:
            kind.model_validate(values)
        except ValidationError as error:
            yield from convert_errors(error, kind, values, f"{table}.params")


def check_programs(wiring: Wiring) -> Mistakes:
    """Check that `[task]` is valid for each level that declares a program."""
    config = wiring.config
    for kind in wiring.programs:
        try:
            program = kind.model_validate(config.task)
        except ValidationError as error:
            yield from convert_errors(error, kind, config.task, "task")
        else:
            for key, value, why in program.find_mismatches(config.robot, config.scene):
                yield Mistake(f"task.{key}", value, why)


def check_sizes(wiring: Wiring, sizes: Mapping[str, int]) -> Mistakes:
    """Check that the rack defines every size to which fields of messages refer.

    Args:
        wiring: The wiring.
        sizes: The defined sizes, such as the number of joints, keyed by name.
    """
    for mailbox, (ports, output) in wiring.writers.items():
        try:
            output.message.message_type.build_dtype(sizes)
        except MailboxError as error:
            yield Mistake(f"mailbox {mailbox}", ports.task, str(error))


def check_memory(layout: Layout) -> Mistakes:
    """Check that the segment is not too large. The mistake names the largest mailbox."""
    size = AddressMap(layout).size
    if size > MAX_SEGMENT_BYTES:
        box = max(layout.mailboxes, key=lambda mailbox: mailbox.depth * mailbox.size)
        why = (
            f"{box.depth} messages are kept for its slowest reader, so the segment needs {size}"
            " bytes"
        )
        advice = f"at most {MAX_SEGMENT_BYTES} are possible; shorten cycles or within_cycles"
        yield Mistake(f"mailbox {box.name}", None, f"{why}; {advice}")


def check_neighbours(wiring: Wiring, contexts: Mapping[str, LevelContext]) -> Mistakes:
    """Check that each level accepts the boards above and below it.

    Args:
        wiring: The wiring.
        contexts: Contexts of the levels, keyed by board. Boards without a context, because of
            mistakes, are not checked, and neither are their neighbours.
    """
    for ports in wiring.tasks:
        board = wiring.config.board[ports.place.board]
        involved = {ports.task, *board.above, *board.below}
        if issubclass(ports.kind, Executor) and involved <= contexts.keys():
            for key, value, why in ports.kind.find_mismatches(contexts[ports.task]):
                yield Mistake(f"board.{ports.task}.{key}", value, why)


def check_scene(wiring: Wiring) -> Mistakes:
    """Check that motions, pushes and goals name existing bodies, and that names are unique."""
    scene = wiring.config.scene
    for kind, key, bodies in (
        ("motion", "body", "obstacles"),
        ("push", "body", "objects"),
        ("goal", "object", "objects"),
    ):
        for at, entry in enumerate(getattr(scene, kind)):
            name = getattr(entry, key)
            known = getattr(scene, bodies)
            if name not in known:
                why = f"no such {bodies[:-1]}; scene.{bodies}: {', '.join(known) or 'none'}"
                yield Mistake(f"scene.{kind}[{at}].{key}", name, why)
    yield from report_repeated_names("scene.objects and scene.obstacles", scene.bodies)


def check_robot(wiring: Wiring) -> Mistakes:
    """Check that the model file can be read and that `[robot]` is consistent.

    Each list must have one value per joint, joint names must be unique, and a hand must have torque
    control.
    """
    robot = wiring.config.robot
    if robot is None:
        return
    try:
        check_regular_file(robot.model, MAX_MODEL_BYTES)
    except OSError as error:
        yield Mistake("robot.model", str(robot.model), f"cannot be read: {error.strerror}")
    for key, values, why in robot.find_length_mismatches():
        yield Mistake(f"robot.{key}", values, why)
    if robot.hand is not None and robot.interface != "torque":
        why = 'tendons of a hand need tensions; must be "torque"'
        yield Mistake("robot.interface", robot.interface, why)
    yield from report_repeated_names("robot.joints", robot.joints)


def check_cell(wiring: Wiring) -> Mistakes:
    """Check that arm and scene match the MuJoCo model.

    If `[robot]` or `[scene]` has other mistakes, check only that the model contains all elements
    that these tables name.
    """
    robot_table, scene_table = wiring.config.robot, wiring.config.scene
    reasons: list[str] = []
    if robot_table is None:
        return
    if not wiring.broken & {"robot", "scene"} and not [*check_robot(wiring), *check_scene(wiring)]:
        try:
            compute_cell_sizes(wiring.config)
            return
        except RobotError as error:
            reasons = [str(error)]
    from rack.levels.robot.lookup import find_unknown_names

    # If the model can be read and lacks some of the named elements, report these instead.
    with suppress(RobotError):
        reasons = [*find_unknown_names(robot_table, scene_table)] or reasons
    for reason in reasons:
        place, colon, why = reason.partition(": ")
        if colon and place.startswith(("robot", "scene")):
            yield Mistake(place, None, why)
        else:
            yield Mistake("robot", None, reason)
