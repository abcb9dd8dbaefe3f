"""A rack of one level with state tables, for tests: up and down, or up alone, and a table with a
hole."""

from __future__ import annotations

import json
from pathlib import Path

from tests.boards.conftest import CLOCK, format_board


def _row(
    name: str, state: str | list[str], when: str, then: str, do: list[str], status: str
) -> str:
    """Return a row of a table; without conditions it fires where no other does."""
    return f"""
[[row]]
name = "{name}"
state = {json.dumps(state)}
{f"when = {{ {when} }}" if when else "else = true"}
next = "{then}"
do = {json.dumps(do)}
status = "{status}"
"""


def _table(states: list[str], then: str, *rows: str) -> str:
    """Return a table whose first rows take commands, in all states."""
    no_command = 'new = "yes", command = ["none", "unknown"]'
    reset = _row("reset", states, 'new = "yes", command = "reset"', then, ["take", "set"], "done")
    other = _row("no such command", states, no_command, then, ["take"], "executing")
    return f'\nstart = "{states[0]}"\n{reset}{other}{"".join(rows)}'


UP, DOWN = ["count up"], ["count down"]
NOT_HIGH = 'new = "no", count = ["low", "between"]'
NOT_LOW = 'new = "no", count = ["high", "between"]'
SAW = _table(
    ["up", "down"],
    "up",
    _row("count up", "up", NOT_HIGH, "same", UP, "executing"),
    _row("turn", "up", 'new = "no", count = "high"', "down", DOWN, "executing"),
    _row("count down", "down", NOT_LOW, "same", DOWN, "executing"),
    _row("turn up", "down", 'new = "no", count = "low"', "up", UP, "executing"),
)
SLOW = _table(
    ["settling", "resting"],
    "same",
    _row("settle", "settling", "", "resting", [], "idle"),
    _row("rest", "resting", "", "same", [], "idle"),
)
HOLE = SAW.replace('count = "low" }', 'count = "low", late = "no" }')


def counting(folder: Path) -> str:
    """Write the tables to `folder`; return the rack's config."""
    for name, text in (("saw", SAW), ("slow", SLOW)):
        (folder / f"{name}.toml").write_text(text)
    return f"""{CLOCK}
[board.counter]
slot = 2
every = 4
executor = "table_levels:Counter"

[board.counter.params.tables]
saw = "saw.toml"
slow = "slow.toml"

{format_board("watch", 3, "wave_levels:Wave", every=8)}"""
