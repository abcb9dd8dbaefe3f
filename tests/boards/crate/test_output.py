"""What host boards print: lines of bounded length, so many of each board, and the others
counted."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from rack.boards.crate import output
from rack.boards.crate.output import LONGEST_LINE, HostOutput, split_lines

MOST = 4


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> Iterator[HostOutput]:
    """The output of a board, of which a run keeps few lines."""
    monkeypatch.setattr(output, "MOST_LINES", MOST)
    pipe = HostOutput("general")
    yield pipe
    os.close(pipe.reader)
    os.close(pipe.writer)


def dropped(lines: int) -> str:
    return f"host board 'general': {lines} lines dropped so far; a run keeps the first {MOST}\n"


def test_complete_lines_are_split_and_an_incomplete_line_waits() -> None:
    long = b"x" * LONGEST_LINE
    assert split_lines(b"one\n\ntwo\nthr") == [b"one\n", b"\n", b"two\n"]
    assert split_lines(long[:-1]) == []
    assert split_lines(long) == [long]
    assert split_lines(long + b"\nrest\n") == [long + b"\n", b"rest\n"]
    assert split_lines(long + b"rest\n") == [long, b"rest\n"]


def test_a_line_in_pieces_is_copied_once_it_is_complete(
    printed: HostOutput, capfd: pytest.CaptureFixture[str]
) -> None:
    for piece, whole in ((b"on", ""), (b"e\ntw", "one\n"), (b"o\n", "two\n")):
        os.write(printed.writer, piece)
        printed.copy_output()
        assert capfd.readouterr().out == whole
    # Nothing has come since.
    printed.copy_output()
    assert capfd.readouterr().out == ""


def test_the_last_line_of_an_ended_board_needs_no_line_end(
    printed: HostOutput, capfd: pytest.CaptureFixture[str]
) -> None:
    os.write(printed.writer, b"one\ntwo")
    printed.copy_output(is_over=True)
    assert capfd.readouterr().out == "one\ntwo\n"
    printed.copy_output(is_over=True)
    assert capfd.readouterr().out == ""


def test_a_run_keeps_the_first_lines_and_reports_each_doubling_of_dropped_lines(
    printed: HostOutput, capfd: pytest.CaptureFixture[str]
) -> None:
    said = []
    for _ in range(12):
        os.write(printed.writer, b"line\n")
        printed.copy_output()
        said.append(capfd.readouterr().out)
    kept = ["line\n"] * MOST
    assert said == [*kept, dropped(1), "", "", "", "", dropped(6), "", ""]
    printed.copy_output(is_over=True)
    assert capfd.readouterr().out == dropped(8)
