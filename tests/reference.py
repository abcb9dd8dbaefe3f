"""The reference of all keys of a config, `configs/REFERENCE.md`, made from `rack schema`.

    make reference         writes the page anew

That is due whenever a key, its range, its default or its meaning changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rack.boards.config import load
from rack.boards.config.reference import KeyTable, list_key_tables

PAGE = Path(__file__).parents[1] / "configs" / "REFERENCE.md"
HEAD = """# All keys of a config

Made by `make reference` from the models that check a config, with the levels of `nasrem` for
`[task]` and `params`; no line is meant to be written by hand. `rack schema TABLE` shows the same,
`rack schema task --config mine.toml` the tables of your own levels.
"""


def page() -> str:
    """Return the page."""
    tables = list_key_tables(load("nasrem"))
    return "\n".join([HEAD, *(line for table in tables for line in _table(table))])


def _table(table: KeyTable) -> Iterator[str]:
    heading = f"## `{table.heading}`" if "[" in table.heading else f"## {table.heading}"
    meaning = _cell(table.meaning)
    yield from (heading, "", f"{meaning[:1].upper()}{meaning[1:]}.", "")
    yield "| key | type | unit | permitted | default | meaning |"
    yield "|---|---|---|---|---|---|"
    for key in table.keys:
        cells = (key.type, key.unit, key.permitted, key.default, key.meaning)
        yield f"| `{key.name}` | {' | '.join(map(_cell, cells))} |"
    yield ""


def _cell(text: str) -> str:
    # As it stands, and not as HTML or another column.
    return text.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    PAGE.write_text(page())
