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

from rack.backplane.segment import SHM_FOLDER
from rack.boards import Rack
from rack.boards.config import load
from rack.boards.crate.line import CrateLine, WarmCrate, receive_or_none
from rack.boards.crate.requests import Preload, Preloading
from rack.boards.errors import LaunchError
from tests.processes import children_of, runs, wait_until

PATH = (*sys.path, str(Path(__file__).parents[1]))


@pytest.fixture
def line() -> Iterator[CrateLine]:
    line = CrateLine()
    yield line
    line.close(0)


def test_a_line_reports_a_lost_other_end_even_within_a_message() -> None:
    ours, theirs = Pipe()
    theirs.send("whole")
    # The length of a message that never comes whole.
    os.write(theirs.fileno(), struct.pack("!i", 100) + b"half")
    theirs.close()
    assert receive_or_none(ours) == "whole"
    assert receive_or_none(ours) is None
    assert receive_or_none(ours) is None


def test_a_crate_that_does_not_end_is_killed() -> None:
    line = CrateLine()
    os.kill(line.pid, signal.SIGSTOP)
    line.close(0.05)
    assert not runs(line.pid)


def test_a_crate_preloads_each_class_once(line: CrateLine) -> None:
    wanted = Preload(("wave_levels:Preloaded",), PATH)
    line.send_request(wanted)
    line.send_request(wanted)
    line.send_request(Preload(("wave_levels:Wave",), PATH))
    # Where the numba cache is empty, the crate also reports each function that it compiles.
    preloadings = []
    for answer in iter(line.receive_message, None):
        if isinstance(answer, Preloading):
            preloadings.append(answer)
        if answer == Preloading("wave_levels:Wave"):
            break
    assert preloadings == [
        Preloading("wave_levels:Preloaded"),
        Preloading("wave_levels:Wave"),
    ]


def test_a_request_to_a_crate_that_is_gone_is_a_launch_error(line: CrateLine) -> None:
    os.kill(line.pid, signal.SIGKILL)
    wait_until(lambda: not runs(line.pid))
    with pytest.raises(LaunchError, match="the crate has ended"):
        line.send_request(Preload((), ()))
    line.try_request(Preload((), ()))


def test_the_crate_ignores_an_interrupt_from_the_terminal() -> None:
    line = CrateLine()
    line.send_request(Preload(("wave_printer:Printer",), PATH))
    wait_until(line.read_output)
    os.kill(line.pid, signal.SIGINT)
    line.close(20.0)
    # Killed by the interrupt, it would have another status.
    assert line._process.returncode == 0


@pytest.fixture
def warm() -> Iterator[WarmCrate]:
    with WarmCrate() as crate:
        yield crate


@pytest.mark.slow
def test_a_warm_crate_serves_racks_one_after_the_other_and_keeps_nothing_of_them(
    small: Path, rack_name: str, warm: WarmCrate
) -> None:
    config = load(small, [f"name={rack_name}"])
    with Rack(config) as cold:
        expected = cold.run(0.5)
    held = []
    for name in (rack_name, rack_name, f"{rack_name}-2"):
        with Rack(config.model_copy(update={"name": name}), crate=warm) as rack:
            assert rack.run(0.5).digest == expected.digest
        assert not [path for path in SHM_FOLDER.iterdir() if rack_name in path.name]
        assert not children_of(warm.pid)
        assert rack_name not in Path(f"/proc/{warm.pid}/maps").read_text()
        held.append(len(list(Path(f"/proc/{warm.pid}/fd").iterdir())))
    assert len(set(held)) == 1
    assert not warm.is_over
    warm.end_crate()
    assert warm.is_over
    assert not runs(warm.pid)
    with pytest.raises(LaunchError, match="the crate has ended"), Rack(config, crate=warm):
        pass


@pytest.mark.slow
def test_a_warm_crate_that_is_killed_is_seen_and_over(
    small: Path, rack_name: str, warm: WarmCrate
) -> None:
    with Rack(load(small, [f"name={rack_name}"]), crate=warm) as rack:
        rack.start()
        os.kill(warm.pid, signal.SIGKILL)
        wait_until(lambda: not rack.watch(0.05))
        assert rack.outcome is not None
        assert rack.outcome.faults == ("the crate ended, and all boards with it",)
    assert warm.is_over
    assert not [path for path in SHM_FOLDER.iterdir() if rack_name in path.name]


@pytest.mark.slow
def test_a_warm_crate_ends_with_its_launcher(warm: WarmCrate) -> None:
    warm.close(0.0)
    assert not warm.is_over
    warm.line.close()
    wait_until(lambda: not runs(warm.pid))
