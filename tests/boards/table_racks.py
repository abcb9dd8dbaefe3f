"""A rack of one level with state tables, for tests: up and down, or up alone, and a table with a
hole."""

from __future__ import annotations

from pathlib import Path

from tests.boards.conftest import CLOCK

RESET = """
[[row]]
name = "reset"
state = ["up", "down"]
when = { new = "yes", command = "reset" }
next = "up"
do = ["take", "set"]
status = "done"

[[row]]
name = "no such command"
state = ["up", "down"]
when = { new = "yes", command = ["none", "unknown"] }
next = "up"
do = ["take"]
status = "executing"
"""
SAW = f"""
start = "up"
{RESET}
[[row]]
name = "count up"
state = "up"
when = {{ new = "no", count = ["low", "between"] }}
next = "same"
do = ["count up"]
status = "executing"

[[row]]
name = "turn"
state = "up"
when = {{ new = "no", count = "high" }}
next = "down"
do = ["count down"]
status = "executing"

[[row]]
name = "count down"
state = "down"
when = {{ new = "no", count = ["high", "between"] }}
next = "same"
do = ["count down"]
status = "executing"

[[row]]
name = "turn up"
state = "down"
when = {{ new = "no", count = "low" }}
next = "up"
do = ["count up"]
status = "executing"
"""
SLOW = f"""
start = "settling"
{RESET.replace('["up", "down"]', '["settling", "resting"]').replace('next = "up"', 'next = "same"')}
[[row]]
name = "settle"
state = "settling"
else = true
next = "resting"
do = []
status = "idle"

[[row]]
name = "rest"
state = "resting"
else = true
next = "same"
do = []
status = "idle"
"""
HOLE = SAW.replace('count = "low" }', 'count = "low", late = "no" }')


def counting(folder: Path, more: str = "") -> str:
    """Write the tables to `folder`; return the rack's config, with `more` for its one board."""
    for name, text in (("saw", SAW), ("slow", SLOW)):
        (folder / f"{name}.toml").write_text(text)
    return f"""{CLOCK}
[board.counter]
slot = 2
every = 4
executor = "table_levels:Counter"
{more}

[board.counter.params.tables]
saw = "saw.toml"
slow = "slow.toml"

[board.watch]
slot = 3
every = 8
executor = "wave_levels:Wave"
"""
