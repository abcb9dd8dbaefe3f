"""`rack schema` as a user runs it."""

from __future__ import annotations

from pathlib import Path

from tests.tools.command_line import rack, read_answer, read_refusal


def test_without_a_table_it_lists_the_tables(small: Path) -> None:
    done = rack("schema", "--config", small)
    assert (done.returncode, done.stderr) == (0, "")
    listed = [line.split()[0] for line in done.stdout.splitlines()]
    assert {"rack", "clock", "board", "board.budget", "fault", "command"} <= set(listed)


def test_each_key_of_a_table_has_unit_range_default_and_meaning(small: Path) -> None:
    title, head, *lines = rack("schema", "clock", "--config", small).stdout.splitlines()
    assert title.startswith("[clock]: ")
    assert head.split() == ["key", "unit", "type", "permitted", "default", "meaning"]
    (line,) = (line for line in lines if line.startswith("period_ms"))
    assert " ".join(line.split()).startswith(
        "period_ms ms number 0.01 to 1000 required tick period; "
    )
    (table,) = read_answer("schema", "clock", "--config", small)
    assert table["heading"] == "[clock]"
    assert {"name", *head.split()[1:]} == set(table["keys"][0])


def test_an_unknown_table_ends_with_status_2_and_one_line(small: Path) -> None:
    refusal = read_refusal(rack("schema", "clok", "--config", small))
    assert refusal.startswith('TABLE = "clok": no such table; tables: rack, clock, ')
