"""`rack new`: write a level, a servo law or a planner to start from."""

from __future__ import annotations

import keyword
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import typer

from rack.backplane.rack_name import RACK_NAME
from rack.boards.config import CONFIGS, list_names, load
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json

TEMPLATES = CONFIGS / "new"


def new(
    kind: Annotated[
        Literal["level", "servo", "planner"],
        typer.Argument(metavar="KIND", help="level, servo or planner"),
    ],
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="name of the Python module, as in my_level")
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="new folder; default: NAME")
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a folder with a class, a config that adds it to nasrem, and a test.

    A level reads and writes messages, and declares a live parameter and an event. A servo law is
    one method: torques from set points and sensed motion. A planner works in the background of a
    level that reads its plans. The files run and pass their test without changes.

    Exit status: 0 written; 2 NAME cannot be a module, or the folder exists already, and nothing is
    written.

    \b
    Examples:
      rack new level my_level && rack run my_level --lockstep --seconds 2
      rack new servo my_law && pytest my_law
      rack new planner my_planner --json
    """
    if why := _find_name_problem(kind, name):
        raise Failure(f'NAME = "{name}": {why}', 2)
    folder = out or Path(name)
    written = {
        folder / path.name.replace(f"my_{kind}", name): _fill_template(path.read_text(), kind, name)
        for path in sorted((TEMPLATES / kind).glob("*my_*"))
    }
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        why = f"'{folder}' exists already; name a new folder with --out"
        raise Failure(why, 2) from None
    for path, text in written.items():
        path.write_text(text, encoding="utf-8")
    config = folder / f"{name}.toml"
    document = {"kind": kind, "name": name, "folder": str(folder), "files": list(map(str, written))}
    lines = (
        *(f"wrote {path}" for path in written),
        "next:",
        f"  rack run {config} --lockstep --seconds 2",
        f"  pytest {folder}",
    )
    print_answer(document, lines, as_json)


def _find_name_problem(kind: str, name: str) -> str:
    """Return the reason why a new module cannot have this name, or an empty string."""
    if not re.fullmatch(RACK_NAME, name) or not name.isidentifier() or keyword.iskeyword(name):
        return "must be at most 40 of a-z, 0-9 and '_', begin with a letter, and not be a keyword"
    if name in list_names() or name in load("nasrem").board:
        return "a bundled config, or a board of nasrem, has that name"
    if find_spec(name) is not None:
        return "an installed module has that name"
    source = (TEMPLATES / kind / f"my_{kind}.py").read_text()
    used_names = re.findall(rf"\b(?!{_class_name(f'my_{kind}')})\w+", source)
    class_names = re.findall(r"^class (\w+)", _fill_template(source, kind, name), re.MULTILINE)
    for clash in sorted({*class_names} & {*used_names}):
        return f"its class would be named {clash}, as a class that it uses"
    return ""


def _class_name(name: str) -> str:
    """Return the class name for a module name, as in `MyLevel` for `my_level`."""
    return "".join(part.capitalize() for part in name.split("_"))


def _fill_template(text: str, kind: str, name: str) -> str:
    """Replace the module and class names of a template in a text by the user's."""
    template_name = f"my_{kind}"
    return text.replace(template_name, name).replace(_class_name(template_name), _class_name(name))
