"""Launches that fail: the reason, and nothing left."""

from __future__ import annotations

import gc
import os
import re
import signal
from pathlib import Path

import pytest

from rack.backplane.lines import UtilityLines
from rack.backplane.segment import list_racks
from rack.backplane.words import Block, TaskState
from rack.boards import Rack
from rack.boards.errors import ConfigError, LaunchError
from rack.boards.events import Event
from tests.boards.conftest import PLAIN, PLANNED, MakeConfig
from tests.processes import BOUND_S, children_of, descriptors, open_files, wait_until
from tests.warm import programs


def refusal(rack: Rack) -> str:
    with pytest.raises(LaunchError) as error:
        rack.launch()
    return str(error.value)


FAILS = {
    "self-test": (
        "board.wave.params.trouble=refuse",
        r"board 'wave': the wave is too high: 3 m; permitted: 2 m",
    ),
    "self-test of a planner": (
        "board.wave.planner=wave_levels:BadPlanner",
        r"board 'wave\.planner': no gain is known: 0 of 3",
    ),
    "not made": ("board.wave.params.final=NONE", r"board 'wave' failed(?s:.*)KeyError: 'NONE'"),
    "left": ("board.wave.params.trouble='leave early'", r"board 'wave' ended: exit status 0"),
    "not preloaded": (
        "board.watch.executor=wave_levels:Unpreloadable",
        r"'wave_levels:Unpreloadable' cannot be preloaded: OSError: no room for compiled code",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", FAILS)
def test_the_reason_of_a_board_is_the_launch_error_and_holds_its_sysfail(
    config: MakeConfig, case: str
) -> None:
    setting, reason = FAILS[case]
    rack = Rack(config(setting, text=PLANNED if "planner" in case else PLAIN))
    assert re.fullmatch(reason, refusal(rack))
    if case not in ("not preloaded", "left"):
        assert 2 in UtilityLines(rack.segment).sysfail
    if case in ("self-test", "not made"):
        assert rack.segment.get_block("wave")[Block.STATE] == TaskState.FAILED


@pytest.mark.slow
def test_a_board_that_is_never_ready_is_named(
    config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    endless = config("board.watch.executor=wave_levels:Endless")
    # On a slow machine the other boards are not ready that soon either, and are named too.
    for limit_s in (0.5, 4.0, BOUND_S):
        monkeypatch.setattr("rack.boards.crate.rack.LAUNCH_S", limit_s)
        reason = refusal(Rack(endless))
        if reason == f"boards watch: not ready within {limit_s:g} s":
            return
        assert re.search(rf"not (ready|done) within {limit_s:g} s", reason)
    pytest.fail(reason)


def test_a_crate_killed_during_the_launch_is_reported(config: MakeConfig) -> None:
    def kill_crate(event: Event) -> None:
        if event.kind == "launch":
            for pid in programs("rack.boards.crate"):
                os.kill(pid, signal.SIGKILL)

    rack = Rack(config(), kill_crate)
    assert "crate" in refusal(rack)
    assert rack.config.name not in list_racks()


@pytest.mark.slow
def test_a_level_is_preloaded_once_in_the_process_that_forks_its_boards(config: MakeConfig) -> None:
    reason = refusal(Rack(config("board.watch.executor=wave_levels:Preloaded", text=PLAIN)))
    preloaded, forked = re.findall(r"\[(\d+)\]", reason)
    assert preloaded == forked
    assert int(preloaded) != os.getpid()


@pytest.mark.slow
def test_a_launch_reports_what_it_waits_for(
    config: MakeConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rack.boards.crate.patience.PATIENCE_S", 0.1)
    # A `SlowlyPreloaded` level waits for it.
    os.mkfifo(gate := tmp_path / "may-load")
    monkeypatch.setenv("WAVE_MAY_LOAD", str(gate))
    waits: list[str] = []

    def let_it_load(event: Event) -> None:
        if event.kind == "waiting" and "SlowlyPreloaded" in event.text and not waits:
            waits.append(event.text)
            os.close(os.open(gate, os.O_WRONLY))

    # Without the report nobody opens the FIFO, and the launch never ends.
    with Rack(config("board.watch.executor=wave_levels:SlowlyPreloaded", text=PLAIN), let_it_load):
        assert waits[0].startswith("preloading 'wave_levels:SlowlyPreloaded'")


@pytest.mark.slow
def test_failed_launches_leave_no_file_open_and_no_process_running(config: MakeConfig) -> None:
    children, before = children_of(os.getpid()), descriptors()
    for _ in range(2):
        refusal(Rack(config("board.wave.params.trouble=refuse")))
    wait_until(lambda: children_of(os.getpid()) == children)
    assert descriptors() == before


def test_a_rack_that_has_run_keeps_no_file_open_until_a_collection(config: MakeConfig) -> None:
    before = descriptors()
    gc.disable()
    try:
        with Rack(config()) as rack:
            rack.run(0.1)
        del rack
        assert open_files() == before
    finally:
        gc.enable()


def test_a_config_that_cannot_be_wired_starts_no_process(
    config: MakeConfig, rack_name: str
) -> None:
    good = config()
    board = good.board["watch"].model_copy(update={"executor": "wave_levels:Nobody"})
    bad = good.model_copy(update={"board": {**good.board, "watch": board}})
    children = children_of(os.getpid())
    with pytest.raises(ConfigError, match="Nobody"):
        Rack(bad).launch()
    assert children_of(os.getpid()) == children
    assert rack_name not in list_racks()


@pytest.mark.slow
def test_a_rack_may_be_closed_before_its_launch_and_twice_after(config: MakeConfig) -> None:
    rack = Rack(config())
    rack.close()
    rack.launch()
    rack.close()
    rack.close()
    assert rack.config.name not in list_racks()
