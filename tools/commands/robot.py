"""`rack robot`: bring up any arm, from a model file to a config that runs."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
import unicodedata
from collections.abc import Container, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import typer

from rack.backplane.rack_name import RACK_NAME
from rack.boards.config import list_names, load
from rack.levels.errors import RobotError
from rack.tools.console.answer import Document, Failure, print_answer
from rack.tools.console.parameters import Json, argument, option
from rack.tools.console.tables import format_fitted_records

if TYPE_CHECKING:
    from rack.tools.robot.draft import ArmOptions
    from rack.tools.robot.findings import ArmExamination
    from rack.tools.robot.source import Source

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Bring up any arm, from MJCF or URDF."
)


@app.command("new")
def new(
    model: Path = argument("MODEL", "model file: MJCF, or URDF"),
    name: str = option("--name NAME", "name of the rack; default: the model's", ""),
    tip: str = option("--tip NAME", "body or site at the end of the arm, to choose one of two", ""),
    joints: str = option(
        "--joints J,J,...", "joints of the arm, base to tool, in place of --tip", ""
    ),
    tool: str = option("--tool NAME", "site or body whose pose is the tool's, z outward", ""),
    gripper: str = option("--gripper NAME|none", "joint that drives the gripper, or none", ""),
    home: str = option("--home NAME|Q,Q,...", "keyframe, or positions of the joints, rad", ""),
    torque: str = option("--torque T,T,...", "torque limits, N m, for a model without any", ""),
    out: Path | None = option("--out DIR", "new folder; default: NAME"),
    as_json: Json = False,
) -> None:
    """Write a folder with a config, a scene and a task for the arm of a model file.

    The config takes the following from the model: the joints along the chain, their limits, torque
    limits from actuators or URDF efforts, and a keyframe. The rest is computed (the tool, a home
    pose free of contact, the drive of the gripper and the joints or jaw that belong to it, bodies
    that always overlap) or guessed. Each guess is listed in the output, in the file, and in [robot]
    guessed. The task moves two blocks on a table, or visits several poses if no gripper can grasp
    blocks. It has been planned successfully. On a terminal the command asks for values that no
    option gives.

    Exit status: 0 written; 2 the model cannot be used, and nothing is written.

    \b
    Examples:
      rack robot new panda.urdf && rack run panda
      rack robot new cell.xml --tip left_hand --name left --home ready
      rack robot new arm.xml --joints j1,j2,j3,j4,j5,j6 --gripper none --json
    """
    from rack.tools.robot.draft import ArmOptions

    is_interactive = sys.stdin.isatty() and sys.stdout.isatty() and not as_json
    taken = list_names()
    derived = derive_name(model.stem, taken)
    name = name or (_ask("name", derived) if is_interactive else derived)
    if not is_free_name(name, taken):
        why = "must be at most 40 of a-z, 0-9, '-' and '_', and not the name of a bundled config"
        raise Failure(f"--name = {name}: {why}; for example {derive_name(name, taken)}", 2)
    folder = out or Path(name)
    if folder.exists():
        raise Failure(f"--out: '{folder}' exists already; name a new folder", 2)
    chain = tuple(filter(None, joints.split(",")))
    wanted = ArmOptions(tip, chain, tool, gripper, home, _parse_torques(torque))
    with draft_folder(model) as draft:
        document = _write_draft(model, wanted, draft / name, name, is_interactive)
        shutil.copytree(draft / name, folder)
    print_answer(
        document | {"folder": str(folder)}, _format_answer(document, folder, name), as_json
    )


@app.command("check")
def check(
    model: str = argument("MODEL|CONFIG", "model file, or config by name or path"),
    out: Path | None = option("--out PNG", "file of the picture; default: NAME.png"),
    as_json: Json = False,
) -> None:
    """Examine an arm before it moves, and draw it.

    The arm is that of a config, or is drafted from a model file as `rack robot new` does. The
    report shows axes, limits, reach, payload at the edge of the reach, contacts at home, unattached
    bodies, actuators by kind, the coupling of the gripper, its fingers, the natural frequency, and
    objects that never stop falling.

    Exit status: 0 all checks pass; 1 a check fails; 2 the model cannot be used.

    \b
    Examples:
      rack robot check nasrem
      rack robot check arm.urdf --out arm.png
    """
    with draft_folder(Path(model)) as folder:
        examined, name = _examine_robot(model, folder)
        from rack.tools.robot.picture import draw_arm

        picture = draw_arm(examined.cell, out or Path(f"{name}.png"))
    able = examined.abilities
    document = {
        "robot": name,
        "joints": examined.joints,
        "reach_m": round(able.reach, 3),
        "payload_kg": round(able.payload, 3),
        "findings": [asdict(finding) for finding in examined.findings],
        "picture": picture,
    }
    print_answer(document, _format_examination(document), as_json)
    if any(finding.fails for finding in examined.findings):
        sys.exit(1)


def _examine_robot(model: str, folder: Path) -> tuple[ArmExamination, str]:
    """Examine the arm of a config or a model file.

    Returns:
        The examination, and the name of the config or model.

    Raises:
        RobotError: The model cannot be used, or the config has no arm.
    """
    from rack.tools.robot.draft import CLOCK_NS, EMPTY_SCENE, ArmOptions, draft_arm
    from rack.tools.robot.findings import examine_arm
    from rack.tools.robot.source import read_source

    if Path(model).suffix not in ("", ".toml"):
        drafted = draft_arm(read_source(Path(model)), ArmOptions(), folder, "arm")
        return examine_arm(drafted.robot, EMPTY_SCENE, CLOCK_NS), derive_name(Path(model).stem, ())
    config = load(model)
    if config.robot is None:
        raise RobotError(f"config '{model}' has no [robot]")
    return examine_arm(config.robot, config.scene, config.clock_ns), config.name


def _format_examination(document: Document) -> Iterator[str]:
    """Yield the lines of the examination as readable text."""
    yield from format_fitted_records(document["joints"])
    yield f"reach {document['reach_m']} m, payload {document['payload_kg']} kg at any pose in reach"
    for finding in document["findings"]:
        verdict = "FAILS" if finding["fails"] else "ok"
        yield f"{verdict}  {finding['about']}: {finding['text']}"
    yield f"picture: {document['picture']}"


def _ask(text: str, default: str = "") -> str:
    """Ask the user for a value, and return the answer, or the default if it is empty.

    If the result is empty, the draft chooses the value.
    """
    question = text if default else f"{text} [found]"
    return str(typer.prompt(question, default, show_default=bool(default))).strip()


def _ask_for_options(source: Source, wanted: ArmOptions) -> ArmOptions:
    """Ask on the terminal for each option that was not given. Raises `RobotError`."""
    from rack.levels.robot.model import format_names
    from rack.tools.robot.arm import find_arm

    arm = find_arm(source.compile_model(), wanted.tip, wanted.joints)
    if arm.others and not (wanted.tip or wanted.joints):
        others = format_names(list(arm.others))
        tip = _ask(f"body at the end of the arm; others begin at {others}", arm.tip)
        if tip != arm.tip:
            wanted = replace(wanted, tip=tip)
            arm = find_arm(source.compile_model(), tip, ())
    tool = wanted.tool or _ask(f"tool: a site or body beyond {arm.tip}, z outward")
    gripper = wanted.gripper
    if arm.fingers and not gripper:
        gripper = _ask(
            f"gripper: none, or the joint that drives it: {format_names(list(arm.fingers))}"
        )
    home = wanted.home or _ask("home: a keyframe, or positions q1,q2,...")
    return replace(wanted, tool=tool, gripper=gripper, home=home)


@contextmanager
def draft_folder(model: Path) -> Iterator[Path]:
    """Provide a temporary folder for a draft.

    Raises:
        Failure: The body of the context raised `RobotError`. The text names the user's model
            instead of files in the folder.
    """
    with TemporaryDirectory() as folder:
        try:
            yield Path(folder)
        except RobotError as error:
            raise Failure(_hide_folder(Path(folder), str(error), model), 2) from None


def _hide_folder(folder: Path, text: str, model: Path) -> str:
    """Replace paths of the temporary folder in a text by the path of the model."""
    return re.sub(f"{re.escape(str(folder))}[^']*", lambda _: str(model), text)


def _parse_torques(text: str) -> tuple[float, ...]:
    """Parse torque limits. Raises `Failure`."""
    try:
        return tuple(float(number) for number in text.split(",") if text)
    except ValueError:
        raise Failure(f"--torque = {text}: must be numbers, as in 80,80,12", 2) from None


def _write_draft(
    model: Path, wanted: ArmOptions, folder: Path, name: str, is_interactive: bool
) -> Document:
    """Write the folder of an arm, and return the answer to `--json`. Raises `RobotError`."""
    from rack.tools.robot.assignment import find_assignment
    from rack.tools.robot.draft import draft_arm
    from rack.tools.robot.folder import build_document, format_config
    from rack.tools.robot.picture import NO_PICTURE, draw_arm
    from rack.tools.robot.source import read_source

    folder.mkdir()
    source = read_source(model)
    if is_interactive:
        wanted = _ask_for_options(source, wanted)
    drafted = draft_arm(source, wanted, folder, name)
    layout = find_assignment(drafted)
    (folder / f"{name}.toml").write_text(
        format_config(drafted, layout, name, model), encoding="utf-8"
    )
    picture = draw_arm(drafted.build_cell(layout.scene), folder / f"{name}.png")
    if picture == NO_PICTURE:
        drafted.notes.append(picture)
    drafted.notes = [_hide_folder(folder, note, model) for note in drafted.notes]
    return build_document(drafted, layout, folder, name)


def _format_answer(document: Document, folder: Path, name: str) -> Iterator[str]:
    """Yield lines about the written folder: its robot, the guesses, and the command to run it."""
    joints = document["joints"]
    yield f"{folder}: {len(joints)} joints, {', '.join(joints)}; {document['task']}"
    yield from document["notes"]
    for key, why in document["guessed"].items():
        yield f"guessed: {key}: {why}"
    config_path = folder / f"{name}.toml"
    # `rack run NAME` would prefer a file NAME.toml in the current directory.
    is_found = folder == Path(name) and not Path(config_path.name).exists()
    yield f"rack run {name if is_found else shlex.quote(str(config_path))}"


def is_free_name(name: str, taken: Container[str]) -> bool:
    """Return True if a name is valid and not taken."""
    return re.fullmatch(RACK_NAME, name) is not None and name not in taken


def derive_name(text: str, taken: Container[str]) -> str:
    """Derive a valid name from a text, such as the name of a file.

    Args:
        text: Any text.
        taken: Names in use. `-arm` is appended to a derived name that is in use.
    """
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    name = re.sub("[^a-z0-9_-]+", "-", plain).lstrip("-_")[:40].rstrip("-_") or "arm"
    return f"{name[:36]}-arm" if name in taken else name
