"""A small vocabulary and a table for tests: a door that opens on command."""

from __future__ import annotations

from pathlib import Path

from rack.levels.systems.state_table.checks import find_flaws
from rack.levels.systems.state_table.level import build_vocabulary
from rack.levels.systems.state_table.table import read_table
from rack.levels.tables import Positive, Table

DOOR = """
start = "shut"

[[row]]
name = "open it"
state = "shut"
when = { command = "open", new = "yes", lock = "free" }
next = "moving"
do = ["take", "drive slowly"]
status = "executing"

[[row]]
name = "locked"
state = "shut"
when = { command = "open", new = "yes", lock = ["stuck", "locked"] }
next = "shut"
do = []
status = "holding"
reason = "locked"

[[row]]
name = "stay shut"
state = "shut"
else = true
next = "same"
do = []
status = "idle"

[[row]]
name = "moves"
state = "moving"
when = { place = "between", late = "no" }
next = "moving"
do = []
status = "executing"

[[row]]
name = "arrived"
state = "moving"
when = { place = ["open", "shut"] }
next = "shut"
do = ["drive stop"]
status = "done"

[[row]]
name = "jams"
state = "moving"
when = { place = "between", late = "yes" }
next = "shut"
do = ["drive stop"]
status = "error"
reason = "the door jams"

[plan]
width = 0.9
"""


class DoorPlan(Table):
    """The plan of a door."""

    width: Positive = 1.0


DOORS = build_vocabulary(
    conditions={"lock": ("free", "stuck", "locked"), "place": ("open", "between", "shut")},
    commands={"open": (), "paint": ("colour",)},
    actions={"drive": (("slowly", "fast", "stop"),)},
    plan=DoorPlan,
)
LEXICON = {"colour": ("red", "green")}


def find_mistakes(folder: Path, text: str) -> list[str]:
    """Return the mistakes in the text of a table."""
    return find_flaws(read_table(write_table(folder, text), DOORS), DOORS, LEXICON)


def write_table(folder: Path, text: str) -> Path:
    path = folder / "door.toml"
    path.write_text(text)
    return path
