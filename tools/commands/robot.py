"""`rack robot`: any arm, from a model file to a config that runs."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import typer

from rack.boards.config import load, names
from rack.levels.errors import RobotError
from rack.tools.console.answer import Document, Failure, print_answer
from rack.tools.console.parameters import Json, argument, option
from rack.tools.console.tables import fitted_records
from rack.tools.robot.rack_name import derive_name, is_free_name

if TYPE_CHECKING:
    from rack.tools.robot.draft import Wishes
    from rack.tools.robot.findings import Examined
    from rack.tools.robot.source import Source

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Bring up any arm, from MJCF or URDF."
)


@app.command("new")
def new(
    model: Path = argument("MODEL", "model file: MJCF, or URDF"),
    name: str = option("--name NAME", "name of the rack; default: the model's", ""),
    tip: str = option("--tip NAME", "body or site at the end of the arm, if there are two", ""),
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
    r"""Write a folder with a config, a scene and a task for the arm of a model file.

    What the model states is taken: the joints along the chain, their limits, torques of actuators
    or of a URDF's efforts, a keyframe. The rest is found (the tool, a home free of contact, the
    gripper's drive, what follows it or the jaw it closes on, bodies that always overlap) or
    guessed: each guess is named here, in the file, and in [robot] guessed. Two blocks on a table
    are moved, or, without a gripper that can, poses toured; the planner has rehearsed it. On a
    terminal it asks for what no option says.

    Exit status: 0 written; 2 nothing can be made of the model, and nothing is written.

    \b
    Examples:
      rack robot new panda.urdf && rack run panda
      rack robot new cell.xml --tip left_hand --name left --home ready
      rack robot new arm.xml --joints j1,j2,j3,j4,j5,j6 --gripper none --json
    """
    from rack.tools.robot.draft import Wishes

    asks = sys.stdin.isatty() and sys.stdout.isatty() and not as_json
    taken = names()
    derived = derive_name(model.stem, taken)
    name = name or (_asked("name", derived) if asks else derived)
    if not is_free_name(name, taken):
        why = "permitted: a-z, 0-9, '-' and '_', at most 40, and no bundled config's name"
        raise Failure(f"--name = {name}: {why}; for example {derive_name(name, taken)}", 2)
    folder = out or Path(name)
    if folder.exists():
        raise Failure(f"--out: '{folder}' is there already; name a folder that is not", 2)
    chain = tuple(filter(None, joints.split(",")))
    wanted = Wishes(tip, chain, tool, gripper, home, _numbers(torque, "--torque"))
    with drafting(model) as draft:
        made = _made(model, wanted, draft / name, name, asks)
        shutil.copytree(draft / name, folder)
    print_answer(made | {"folder": str(folder)}, _lines(made, folder, name), as_json)


@app.command("check")
def check(
    model: str = argument("MODEL|CONFIG", "model file, or config by name or path"),
    out: Path | None = option("--out PNG", "file of the picture; default: NAME.png"),
    as_json: Json = False,
) -> None:
    r"""Examine an arm before it moves, and draw it: everything at once.

    Of a config its arm, of a model file the arm that `rack robot new` would make of it: axes,
    limits, reach, payload at the edge of its reach, contacts at home, bodies that nothing holds,
    actuators by kind, coupling of the gripper, one finger or two, natural frequency, objects that
    fall without end.

    Exit status: 0 all is well; 1 something fails; 2 nothing can be made of it.

    \b
    Examples:
      rack robot check nasrem
      rack robot check arm.urdf --out arm.png
    """
    with drafting(Path(model)) as folder:
        examined, name = _examined(model, folder)
        from rack.tools.robot.picture import draw

        picture = draw(examined.cell, out or Path(f"{name}.png"))
    able = examined.able
    document = {
        "robot": name,
        "joints": examined.joints,
        "reach_m": round(able.reach, 3),
        "payload_kg": round(able.payload, 3),
        "findings": [asdict(finding) for finding in examined.findings],
        "picture": picture,
    }
    print_answer(document, _report(document), as_json)
    if any(finding.fails for finding in examined.findings):
        sys.exit(1)


def _examined(given: str, folder: Path) -> tuple[Examined, str]:
    """Return the arm of a config or a model, and its name. Raises `RobotError`."""
    from rack.tools.robot.draft import CLOCK_NS, NOTHING, Wishes, draft
    from rack.tools.robot.findings import examine
    from rack.tools.robot.source import read_source

    if Path(given).suffix not in ("", ".toml"):
        made = draft(read_source(Path(given)), Wishes(), folder, "arm")
        return examine(made.robot, NOTHING, CLOCK_NS), derive_name(Path(given).stem, ())
    config = load(given)
    if config.robot is None:
        raise RobotError(f"config '{given}' has no [robot]")
    return examine(config.robot, config.scene, config.clock_ns), config.name


def _report(found: Document) -> Iterator[str]:
    yield from fitted_records(found["joints"])
    yield f"reach {found['reach_m']} m, payload {found['payload_kg']} kg wherever it reaches"
    for finding in found["findings"]:
        verdict = "FAILS" if finding["fails"] else "ok"
        yield f"{verdict}  {finding['about']}: {finding['text']}"
    yield f"picture: {found['picture']}"


def _asked(text: str, default: str = "") -> str:
    """Return what the user answers; nothing, where the default is what is found."""
    shown = text if default else f"{text} [found]"
    return str(typer.prompt(shown, default, show_default=bool(default))).strip()


def _completed(source: Source, wanted: Wishes) -> Wishes:
    """Ask on the terminal for what no option says. Raises `RobotError`."""
    from rack.levels.robot.model import listed
    from rack.tools.robot.arm import find_arm

    arm = find_arm(source.compiled(), wanted.tip, wanted.joints)
    if arm.others and not (wanted.tip or wanted.joints):
        others = listed(list(arm.others))
        tip = _asked(f"body at the end of the arm; others begin at {others}", arm.tip)
        if tip != arm.tip:
            wanted = replace(wanted, tip=tip)
            arm = find_arm(source.compiled(), tip, ())
    tool = wanted.tool or _asked(f"tool: a site or body beyond {arm.tip}, z outward")
    gripper = wanted.gripper
    if arm.fingers and not gripper:
        gripper = _asked(f"gripper: none, or the joint that drives it: {listed(list(arm.fingers))}")
    home = wanted.home or _asked("home: a keyframe, or positions q1,q2,...")
    return replace(wanted, tool=tool, gripper=gripper, home=home)


@contextmanager
def drafting(model: Path) -> Iterator[Path]:
    """Provide a temporary folder; errors name the user's model in place of files in it. Raises
    `Failure`.
    """
    with TemporaryDirectory() as folder:
        try:
            yield Path(folder)
        except RobotError as error:
            raise Failure(_without(Path(folder), str(error), model), 2) from None


def _without(folder: Path, text: str, model: Path) -> str:
    return re.sub(f"{re.escape(str(folder))}[^']*", lambda _: str(model), text)


def _numbers(text: str, option: str) -> tuple[float, ...]:
    try:
        return tuple(float(number) for number in text.split(",") if text)
    except ValueError:
        raise Failure(f"{option} = {text}: not numbers, as in 80,80,12", 2) from None


def _made(model: Path, wanted: Wishes, folder: Path, name: str, asks: bool) -> Document:
    """Write the folder of an arm, asking for more if `asks`; return what it is. Raises
    `RobotError`.
    """
    from rack.tools.robot.assignment import lay_out
    from rack.tools.robot.draft import draft
    from rack.tools.robot.folder import config_text, document
    from rack.tools.robot.picture import NO_PICTURE, draw
    from rack.tools.robot.source import read_source

    folder.mkdir()
    source = read_source(model)
    if asks:
        wanted = _completed(source, wanted)
    made = draft(source, wanted, folder, name)
    layout = lay_out(made)
    (folder / f"{name}.toml").write_text(config_text(made, layout, name, model), encoding="utf-8")
    picture = draw(made.cell(layout.scene), folder / f"{name}.png")
    if picture == NO_PICTURE:
        made.notes.append(picture)
    made.notes = [_without(folder, note, model) for note in made.notes]
    return document(made, layout, folder, name)


def _lines(made: Document, folder: Path, name: str) -> Iterator[str]:
    yield f"{folder}: {len(made['joints'])} joints, {', '.join(made['joints'])}; {made['task']}"
    yield from made["notes"]
    for key, why in made["guessed"].items():
        yield f"guessed: {key}: {why}"
    own = folder / f"{name}.toml"
    # By name a file beside the folder is found first.
    is_found = folder == Path(name) and not Path(own.name).exists()
    yield f"rack run {name if is_found else shlex.quote(str(own))}"
