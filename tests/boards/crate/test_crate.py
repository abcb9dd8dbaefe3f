"""The crate and its line: requests, answers, the boards' output, and the end."""

from __future__ import annotations

import os
import signal
import struct
import sys
from collections.abc import Iterator
from multiprocessing import Pipe
from pathlib import Path

import pytest

from rack.boards.crate.line import CrateLine, received
from rack.boards.crate.requests import Preload, Preloading
from rack.boards.errors import LaunchError
from tests.processes import descriptors, runs, wait_until

PATH = (*sys.path, str(Path(__file__).parents[1]))


@pytest.fixture
def line() -> Iterator[CrateLine]:
    line = CrateLine()
    yield line
    line.close(0)


def test_a_line_says_when_its_other_end_is_gone_even_in_half_a_message() -> None:
    ours, theirs = Pipe()
    theirs.send("whole")
    # The length of a message that never comes whole.
    os.write(theirs.fileno(), struct.pack("!i", 100) + b"half")
    theirs.close()
    assert received(ours) == "whole"
    assert received(ours) is None
    assert received(ours) is None


@pytest.mark.slow
def test_the_crate_ends_when_its_line_is_closed() -> None:
    before = descriptors()
    line = CrateLine()
    line.close(20.0)
    assert not runs(line.pid)
    assert descriptors() == before


def test_a_crate_that_does_not_end_is_killed() -> None:
    line = CrateLine()
    os.kill(line.pid, signal.SIGSTOP)
    line.close(0.05)
    assert not runs(line.pid)


def test_output_comes_line_by_line_and_once(line: CrateLine) -> None:
    line.send(Preload(("wave_printer:Printer",), PATH))
    found: list[str] = []
    wait_until(lambda: found.extend(line.printed()) or len(found) == 2)
    assert found == ["first", "second"]
    assert line.printed() == []


def test_the_crate_survives_a_module_that_cannot_be_imported(line: CrateLine) -> None:
    line.send(Preload(("no_such_module:Level", "wave_printer:Printer"), PATH))
    wait_until(line.printed)
    assert runs(line.pid)


def test_what_a_crate_has_preloaded_it_does_not_preload_again(line: CrateLine) -> None:
    wanted = Preload(("wave_levels:Preloaded",), PATH)
    line.send(wanted)
    line.send(wanted)
    line.send(Preload(("wave_levels:Wave",), PATH))
    assert [line.receive() for _ in range(2)] == [
        Preloading("wave_levels:Preloaded"),
        Preloading("wave_levels:Wave"),
    ]


def test_a_request_to_a_crate_that_is_gone_is_a_launch_error(line: CrateLine) -> None:
    os.kill(line.pid, signal.SIGKILL)
    wait_until(lambda: not runs(line.pid))
    with pytest.raises(LaunchError, match="the crate has ended"):
        line.send(Preload((), ()))
    line.ask(Preload((), ()))


def test_the_crate_ignores_an_interrupt_from_the_terminal() -> None:
    line = CrateLine()
    line.send(Preload(("wave_printer:Printer",), PATH))
    wait_until(line.printed)
    os.kill(line.pid, signal.SIGINT)
    line.close(20.0)
    # Killed by the interrupt, it would have another status.
    assert line._process.returncode == 0
