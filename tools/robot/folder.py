"""What `rack robot new` writes: a config with comments, the model that it names, a picture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rack.backplane.json_text import encode_json
from rack.levels.tables import Table
from rack.tools.robot.assignment import Assignment
from rack.tools.robot.draft import Draft

HEAD = """# {name}: the levels and boards of nasrem with the arm of {model!r}, by `rack robot new`.
format = 2
name = "{name}"
extends = ["nasrem"]

[robot]
# What follows is a guess, as the comments say. A simulated arm runs on it; any other is not enabled
# until you have confirmed each key, and taken it from this list.
"""
STIFF = "stiff enough against dry friction"


def config_text(made: Draft, layout: Assignment, name: str, model: Path) -> str:
    """Return the config of a drafted arm."""
    head = HEAD.format(name=name, model=model.name)
    return head + "\n".join(_lines(made, layout, name)) + "\n"


def _lines(made: Draft, layout: Assignment, name: str) -> Iterator[str]:
    table: dict[str, Any] = {"guessed": list(made.guessed), **made.table, "model": f"{name}.xml"}
    inner = {key: value for key, value in table.items() if isinstance(value, Table)}
    yield from _keys({k: v for k, v in table.items() if k not in inner}, made.guessed)
    for key, value in inner.items():
        yield f"\n[robot.{key}]" + _comment(made.guessed.get(key))
        inside = value.model_dump(exclude_none=True)
        follow = inside.pop("follow", ())
        yield from _keys(inside, {})
        for one in follow:
            yield f"[[robot.{key}.follow]]"
            yield from _keys(one, {})
    if made.limits.bandwidth is not None:
        yield f"\n[board.servo.params]\nbandwidth = {made.limits.bandwidth:g}" + _comment(STIFF)
    yield "\n[scene]"
    yield from _keys({"objects": layout.scene.objects, "supports": layout.scene.supports}, {})
    yield f"\n[task]  # {layout.kind}"
    for action in layout.actions:
        yield "[[task.action]]"
        yield from _keys(action, {})


def _keys(table: Mapping[str, Any], guessed: Mapping[str, str]) -> Iterator[str]:
    # Of numbers, texts and lists JSON is TOML.
    for key, value in table.items():
        yield f"{key} = {encode_json(value)}" + _comment(guessed.get(key))


def _comment(guess: str | None) -> str:
    return f"  # guessed: {guess}" if guess else ""


def document(made: Draft, layout: Assignment, folder: Path, name: str) -> dict[str, Any]:
    """Return what was made as plain data."""
    return {
        "robot": name,
        "folder": str(folder),
        "joints": made.arm.joints,
        "task": layout.kind,
        "guessed": made.guessed,
        "notes": made.notes,
    }
