"""A board's process: its name and its exit status."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rack.backplane.errors import MailboxError
from rack.backplane.segment import Segment
from rack.boards.run.board import SELF_TEST_FAILED, UNRECOVERABLE_STATUS, run_board
from rack.levels.errors import CannotGoOn, LevelError
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, forked

pytestmark = pytest.mark.filterwarnings(FORKS)


def raising(error: Exception) -> Callable[[Segment], int]:
    """Return a board that ends with an error."""

    def board(segment: Segment) -> int:
        raise error

    return board


def ended(segment: Segment, board: Callable[[Segment], int]) -> tuple[int, str]:
    """Run a board in a process of its own; return its exit status and what it printed."""
    crate = os.getpid()
    reading, writing = os.pipe()

    def run() -> None:
        os.dup2(writing, 2)
        sys.stderr = os.fdopen(2, "w")  # pytest has one of its own
        os._exit(run_board(crate, "level", segment, board))

    with forked(run) as pid:
        os.close(writing)
        with os.fdopen(reading) as lines:
            printed = lines.read()
        return exit_status(pid), printed


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (LevelError("no arm"), SELF_TEST_FAILED, "board 'level': no arm\n"),
        (MailboxError("taken"), SELF_TEST_FAILED, "board 'level': taken\n"),
        (CannotGoOn("alone"), UNRECOVERABLE_STATUS, "board 'level': alone\n"),
    ],
)
def test_the_exit_status_gives_the_reason_why_a_board_ended(
    make_bus: MakeBus, error: Exception, status: int, said: str
) -> None:
    assert ended(make_bus(task("level")), raising(error)) == (status, said)


def test_a_mistake_in_a_level_ends_its_board_with_a_traceback(make_bus: MakeBus) -> None:
    status, said = ended(make_bus(task("level")), raising(ZeroDivisionError("by zero")))
    assert status == 1
    assert said.startswith("board 'level' failed:\nTraceback")
    assert said.endswith("ZeroDivisionError: by zero\n")


def test_a_board_that_ends_regularly_has_its_exit_status_and_name(make_bus: MakeBus) -> None:
    def board(segment: Segment) -> int:
        os.write(2, Path("/proc/self/comm").read_bytes())
        return 7

    segment = make_bus(task("level"))
    # The kernel keeps 15 letters.
    assert ended(segment, board) == (7, f"{segment.rack}:level"[:15] + "\n")
