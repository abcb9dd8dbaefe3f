"""Tests that tables fit the terminal, and text and tables fit a pipe."""

from __future__ import annotations

import io
import shlex

import pytest
from rich.console import Console

from rack.tools.console.answer import PIPE_WIDTH
from rack.tools.console.tables import (
    TextTable,
    format_table,
    print_blocks,
    render_markdown,
    render_text,
)

HEAD = ("task", "count", "what it says of itself")
ROWS = (("servo", "12", "torque of j3 is NaN, and rejected"), ("elemental_move", "7", "idle"))


def test_numbers_stand_to_the_right_and_texts_to_the_left() -> None:
    assert list(format_table(HEAD, ROWS)) == [
        "task            count  what it says of itself",
        "servo              12  torque of j3 is NaN, and rejected",
        "elemental_move      7  idle",
    ]


@pytest.mark.parametrize("width", [30, 40, 55, 56, 80])
def test_a_table_fits_its_width_with_long_cells_wrapped(width: int) -> None:
    lines = list(format_table(HEAD, ROWS, width))
    assert max(map(len, lines)) <= width
    assert (len(lines) == 3) == (width >= 56)
    assert " ".join(" ".join(lines).split()).count("12") == 1


def test_optional_columns_are_dropped_before_cells_become_narrow() -> None:
    assert list(format_table(HEAD, ROWS, 40, ("what it says of itself", "count"))) == [
        "task            count",
        "servo              12",
        "elemental_move      7",
    ]
    assert list(format_table(HEAD, ROWS, 56, ("count",))) == list(format_table(HEAD, ROWS))
    # 25 columns are enough for a text.
    assert next(format_table(HEAD, ROWS, 48, ("count",))).split()[:2] == ["task", "count"]
    assert next(format_table(HEAD, ROWS, 47, ("count",))).split()[:2] == ["task", "what"]


def test_without_a_width_a_table_is_neither_cut_nor_coloured_nor_read_as_markup() -> None:
    rows = [["[red]a[/red]", "x" * 5000, ":smile:"]]
    assert list(format_table(("a", "b", "c"), rows))[1].split() == rows[0]


def test_no_word_is_lost_where_a_column_is_narrower_than_it() -> None:
    lines = list(format_table(("name", "what"), [["a" * 30, "b" * 30]], 20))
    assert max(map(len, lines)) <= 20
    assert ["".join(lines).count(letter) for letter in "ab"] == [30 + 2, 30]


BLOCKS = (
    "# Levels",
    TextTable([{"R": 2.5, "level": "servo", "d": 3}, {"R": 1e3, "level": "task", "d": None}]),
    "all held",
)


def test_markdown_and_pipe_output_have_the_same_content() -> None:
    assert render_markdown(BLOCKS) == (
        "# Levels\n"
        "| R    | level | d |\n"
        "|------|-------|---|\n"
        "| 2.5  | servo | 3 |\n"
        "| 1000 | task  | - |\n"
        "all held\n"
    )
    assert list(render_text(BLOCKS)) == [
        "# Levels",
        "   R  level  d",
        " 2.5  servo  3",
        "1000  task   -",
        "all held",
    ]


def test_titles_on_a_terminal_have_no_hash_sign() -> None:
    terminal = Console(width=40, record=True, file=io.StringIO(), force_terminal=True)
    print_blocks(BLOCKS, terminal)
    lines = [line.rstrip() for line in terminal.export_text().splitlines()]
    assert lines == ["Levels", *list(render_text(BLOCKS))[1:]]


def test_a_pipe_gets_wrapped_text_and_commands_that_can_be_pasted(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["rack", "check", *(f"--set=board.a{k}.core={k}" for k in range(20))]
    command = "  " + " ".join(words)
    text = "a sentence of many words " * 12
    print_blocks([TextTable([{"what": "word " * 40, "count": 7}]), text, "", command])
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= PIPE_WIDTH
    blank = lines.index("")
    assert " ".join(map(str.strip, lines[:blank])).endswith(text.strip())
    assert shlex.split("\n".join(lines[blank:]).replace("\\\n", "")) == words


def test_a_word_wider_than_a_pipe_is_not_broken(capsys: pytest.CaptureFixture[str]) -> None:
    path = "/" + "folder/" * 20
    print_blocks([f"written: {path}"])
    assert path in capsys.readouterr().out.split()
