"""`rack schema` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

from tests.tools.command_line import rack


def test_without_a_table_it_lists_the_tables(small: Path) -> None:
    done = rack("schema", "--config", small)
    assert (done.returncode, done.stderr) == (0, "")
    listed = [line.split()[0] for line in done.stdout.splitlines()]
    assert {"rack", "clock", "board", "board.budget", "fault", "command"} <= set(listed)


def test_each_key_of_a_table_is_one_line_with_unit_range_default_and_meaning(small: Path) -> None:
    done = rack("schema", "clock", "--config", small)
    title, head, *lines = done.stdout.splitlines()
    assert title.startswith("[clock]: ")
    assert head.split() == ["key", "unit", "type", "permitted", "default", "meaning"]
    (line,) = (line for line in lines if line.startswith("period_ms"))
    assert line.split(maxsplit=7) == [
        "period_ms",
        "ms",
        "number",
        "0.01",
        "to",
        "1000",
        "required",
        "tick period; a whole number of ns",
    ]


def test_json_holds_the_same(small: Path) -> None:
    done = rack("schema", "clock", "--json", "--config", small)
    (table,) = json.loads(done.stdout)
    assert table["heading"] == "[clock]"
    assert {"name", "type", "unit", "permitted", "default", "meaning"} == set(table["keys"][0])


def test_an_unknown_table_ends_with_status_2_and_one_line(small: Path) -> None:
    done = rack("schema", "clok", "--config", small)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith('TABLE = "clok": no such table; tables: rack, clock, ')
    assert len(done.stderr.splitlines()) == 1
