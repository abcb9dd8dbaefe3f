"""`rack schema`: show the keys of a config, taken from the models that validate it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING

from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, argument, complete_config_name, option
from rack.tools.console.tables import format_fitted_table

if TYPE_CHECKING:
    from rack.boards.config.reference import KeyTable

DROPPED = ("type", "permitted", "default")
"""Columns that a narrow terminal leaves out, in this order."""


def schema(
    name: str | None = argument(
        "[TABLE]", "table, such as clock, board.budget or board.servo.params", None
    ),
    config: str = option(
        "--config CONFIG",
        "config whose levels declare [task] and params",
        "nasrem",
        autocompletion=complete_config_name,
    ),
    as_json: Json = False,
) -> None:
    """Show the keys of a config: type, unit, permitted values, default and meaning.

    Without TABLE the command lists the tables. [task] and [board.<name>.params] depend on the
    levels of CONFIG. The beginning of a name selects all tables whose names begin with it.

    \b
    Examples:
      rack schema
      rack schema board
      rack schema board.servo.params
      rack schema task --config mine.toml
    """
    from rack.boards.config import load
    from rack.boards.config.reference import find_tables, list_key_tables

    rack = load(config)
    try:
        tables = list_key_tables(rack) if name is None else find_tables(name, rack)
    except LookupError as error:
        raise Failure(f'TABLE = "{name}": {error.args[0]}', 2) from None
    lines = _format_keys(tables)
    if name is None:
        rows = [[entry.name, entry.heading, entry.meaning] for entry in tables]
        lines = format_fitted_table(["table", "in TOML", "meaning"], rows, ("in TOML",))
    print_answer([asdict(entry) for entry in tables], lines, as_json)


def _format_keys(tables: list[KeyTable]) -> Iterator[str]:
    """Yield the lines of each table with its keys."""
    head = ["key", "unit", "type", "permitted", "default", "meaning"]
    for at, table in enumerate(tables):
        rows = [[k.name, k.unit, k.type, k.permitted, k.default, k.meaning] for k in table.keys]
        if at:
            yield ""
        yield f"{table.heading}: {table.meaning}"
        yield from format_fitted_table(head, rows, DROPPED)
