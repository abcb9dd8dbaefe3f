"""`rack schema`: every key of a config, from the models that validate it."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from rack.tools.answer import Failure, Json, configs, print_json

if TYPE_CHECKING:
    from rack.boards.config.reference import KeyTable

EXAMPLES = (
    "Examples: rack schema; rack schema board; rack schema board.servo.params; rack schema task --config mine.toml"
)
DROPPED = ("default", "permitted", "type")
"""Columns that a narrow terminal does not show, in that order."""

TableName = Annotated[
    str | None, typer.Argument(metavar="[TABLE]", help="table, such as clock, board.budget or board.servo.params")
]
Of = Annotated[
    str,
    typer.Option(
        "--config", metavar="CONFIG", help="config whose levels declare [task] and params", autocompletion=configs
    ),
]


def schema(name: TableName = None, config: Of = "nasrem", as_json: Json = False) -> None:
    """Show the keys of a config: type, unit, permitted values, default and meaning.

    Without TABLE it lists the tables. The levels' own tables, [task] and [board.<name>.params], are those of the boards
    in CONFIG. A part of a name shows all tables that begin with it.
    """
    from rack.boards.config import load
    from rack.boards.config.reference import find_tables, key_tables

    rack = load(config)
    try:
        found = key_tables(rack) if name is None else find_tables(name, rack)
    except LookupError as error:
        raise Failure(f'TABLE = "{name}": {error.args[0]}', 2) from None
    if as_json:
        print_json([asdict(entry) for entry in found])
    elif name is None:
        _list(found)
    else:
        _show(found)


def _list(found: list[KeyTable]) -> None:
    from rack.tools.live_table import terminal_width
    from rack.tools.text_table import table

    rows = [[entry.name, entry.heading, entry.meaning] for entry in found]
    print(*table(["table", "in TOML", "meaning"], rows, terminal_width(), ("in TOML",)), sep="\n")


def _show(found: list[KeyTable]) -> None:
    from rack.tools.live_table import terminal_width
    from rack.tools.text_table import table

    for at, entry in enumerate(found):
        rows = [[k.name, k.unit, k.type, k.permitted, k.default, k.meaning] for k in entry.keys]
        title = f"{entry.heading}: {entry.meaning}"
        head = ["key", "unit", "type", "permitted", "default", "meaning"]
        print(*([""] if at else []), title, *table(head, rows, terminal_width(), DROPPED), sep="\n")
