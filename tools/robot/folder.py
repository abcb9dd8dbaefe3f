"""Writes the config of a drafted arm, with comments that name each guess."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rack.backplane.json_text import encode_json
from rack.levels.tables import Table
from rack.tools.robot.assignment import Assignment
from rack.tools.robot.draft import Draft

CONFIG_HEAD = """\
# {name}: the levels and boards of nasrem with the arm of {model!r}, by `rack robot new`.
format = 2
name = "{name}"
extends = ["nasrem"]

[robot]
# These values are guesses, as the comments say. A simulated arm runs on them; any other is not
# enabled until you have confirmed each key, and taken it from this list.
"""
STIFF = "stiff enough against dry friction"


def format_config(draft: Draft, layout: Assignment, name: str, model: Path) -> str:
    """Format the config of a drafted arm.

    Args:
        draft: The arm.
        layout: Its scene and task.
        name: Name of the rack.
        model: The user's model file, which is named in a comment.
    """
    head = CONFIG_HEAD.format(name=name, model=model.name)
    return head + "\n".join(_format_tables(draft, layout, name)) + "\n"


def _format_tables(draft: Draft, layout: Assignment, name: str) -> Iterator[str]:
    """Yield the lines of the config after its head."""
    table: dict[str, Any] = {"guessed": list(draft.guessed), **draft.table, "model": f"{name}.xml"}
    subtables = {key: value for key, value in table.items() if isinstance(value, Table)}
    yield from _format_keys({k: v for k, v in table.items() if k not in subtables}, draft.guessed)
    for key, value in subtables.items():
        yield f"\n[robot.{key}]" + _format_guess(draft.guessed.get(key))
        settings = value.model_dump(exclude_none=True)
        follow = settings.pop("follow", ())
        yield from _format_keys(settings, {})
        for follower in follow:
            yield f"[[robot.{key}.follow]]"
            yield from _format_keys(follower, {})
    if draft.limits.bandwidth is not None:
        yield f"\n[board.servo.params]\nbandwidth = {draft.limits.bandwidth:g}" + _format_guess(
            STIFF
        )
    yield "\n[scene]"
    yield from _format_keys(
        {"objects": layout.scene.objects, "supports": layout.scene.supports}, {}
    )
    yield f"\n[task]  # {layout.kind}"
    for action in layout.actions:
        yield "[[task.action]]"
        yield from _format_keys(action, {})


def _format_keys(table: Mapping[str, Any], guessed: Mapping[str, str]) -> Iterator[str]:
    """Yield a line of TOML for each key, with the reason for a guess as a comment."""
    # JSON and TOML write numbers, strings and lists in the same way.
    for key, value in table.items():
        yield f"{key} = {encode_json(value)}" + _format_guess(guessed.get(key))


def _format_guess(guess: str | None) -> str:
    """Return a TOML comment with the reason for a guess, or "" if the value is not a guess."""
    return f"  # guessed: {guess}" if guess else ""


def build_document(draft: Draft, layout: Assignment, folder: Path, name: str) -> dict[str, Any]:
    """Build the document that `--json` prints.

    Args:
        draft: The arm.
        layout: Its scene and task.
        folder: Folder to which the config is written.
        name: Name of the rack.
    """
    return {
        "robot": name,
        "folder": str(folder),
        "joints": draft.arm.joints,
        "task": layout.kind,
        "guessed": draft.guessed,
        "notes": draft.notes,
    }
