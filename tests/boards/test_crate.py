"""The crate and its line: requests, answers, what boards print, and the end."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.boards.channel import Channel
from rack.boards.crate_line import CrateLine
from rack.boards.crate_messages import Preload
from rack.boards.errors import LaunchError
from tests.processes import descriptors, runs, wait_until

PATH = (*sys.path, str(Path(__file__).parent))


@pytest.fixture
def pair() -> Iterator[tuple[Channel, socket.socket]]:
    ours, theirs = socket.socketpair()
    yield Channel(ours), theirs
    ours.close()
    theirs.close()


@pytest.fixture
def line() -> Iterator[CrateLine]:
    line = CrateLine()
    yield line
    line.close(0)


def test_objects_arrive_in_order_however_large(pair: tuple[Channel, socket.socket]) -> None:
    channel, end = pair
    other = Channel(end)
    sent = [Preload(("a", "b"), ()), None, {"x": 1}, "y" * 50_000]
    for message in sent:
        channel.send(message)
    assert [other.receive() for _ in sent] == sent


def test_half_a_message_is_waited_for_and_its_senders_end_ends_it(pair: tuple[Channel, socket.socket]) -> None:
    channel, end = pair
    data = pickle.dumps("whole")
    whole = struct.pack("<Q", len(data)) + data
    end.sendall(whole + whole[:-2])
    end.shutdown(socket.SHUT_WR)
    assert channel.receive() == "whole"
    assert channel.receive() is None


def test_a_line_without_its_other_end_says_so(pair: tuple[Channel, socket.socket]) -> None:
    channel, end = pair
    end.close()
    assert channel.receive() is None
    with pytest.raises(OSError, match="Broken pipe"):
        channel.send("anything")


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


def test_what_is_printed_comes_line_by_line_and_once(line: CrateLine) -> None:
    line.send(Preload(("wave_printer",), PATH))
    found: list[str] = []
    wait_until(lambda: found.extend(line.printed()) or len(found) == 2)
    assert found == ["first", "second"]
    assert line.printed() == []


def test_a_module_that_does_not_import_is_not_the_crates_affair(line: CrateLine) -> None:
    line.send(Preload(("no_such_module", "wave_printer"), PATH))
    wait_until(line.printed)
    assert runs(line.pid)


def test_a_request_to_a_crate_that_is_gone_is_a_launch_error(line: CrateLine) -> None:
    os.kill(line.pid, signal.SIGKILL)
    wait_until(lambda: not runs(line.pid))
    with pytest.raises(LaunchError, match="the crate has ended"):
        line.send(Preload((), ()))
    line.ask(Preload((), ()))


def test_an_interrupt_from_the_terminal_is_the_racks_affair() -> None:
    line = CrateLine()
    line.send(Preload(("wave_printer",), PATH))
    wait_until(line.printed)
    os.kill(line.pid, signal.SIGINT)
    line.close(20.0)
    # Killed by the interrupt it would have a status of its own.
    assert line._process.returncode == 0
