"""Two racks on one machine: a core held by one is not taken by the other without a warning."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from rack.backplane.process import Reservation, name_process, take_core
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.crate.neighbours import find_holders
from rack.boards.errors import ConfigError
from tests.boards.conftest import CLOCK, PLAIN, MakeConfig, format_board
from tests.machine import needs_deadlines, needs_fifo, needs_two_cores
from tests.processes import FORKS, RACK, exit_status, fork, forked, run_to_end, wait_until

ROOT = Path(__file__).resolve().parents[3]
BOUND_S = 60
FIFO = ("clock.mode=realtime", "board.wave.priority=5")
ELSEWHERE = CLOCK + format_board("wave", 2, "wave_levels:Wave", rate_hz=400, priority=5)
"""A rack whose board names no core."""


@pytest.fixture
def first(config: MakeConfig, rack_name: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rack]:
    """A rack whose wave holds core 0; no other test's racks are seen."""
    monkeypatch.setattr("rack.boards.crate.neighbours.list_racks", lambda: [rack_name])
    with Rack(config(*FIFO, "board.wave.core=0", text=PLAIN)) as rack:
        yield rack


def second(config: MakeConfig, rack: Rack, *settings: str, text: str = PLAIN) -> RackConfig:
    return config(*FIFO, f"name={rack.config.name}b", *settings, text=text)


@needs_fifo
def test_a_held_core_is_refused_with_its_holder(config: MakeConfig, first: Rack) -> None:
    with pytest.raises(ConfigError) as refused:
        Rack(second(config, first, "board.wave.core=0"), share=False).launch()
    holder = (
        f"rack '{first.config.name}' (process {os.getpid()}) runs wave on it at real-time priority"
    )
    wanted = (
        f"core 0, requested by wave: {holder}: stop that rack, choose other cores, or use --share"
    )
    assert str(refused.value) == wanted


@pytest.mark.slow
@needs_fifo
def test_a_rack_that_shares_a_core_reports_it(config: MakeConfig, first: Rack) -> None:
    with Rack(second(config, first, "board.wave.core=0")) as rack:
        # Before all else: what follows takes long while other boards have the core.
        event = rack.events[0]
    assert event.kind == "waiting"
    assert event.text.startswith(f"core 0, requested by wave: rack '{first.config.name}'")


@needs_fifo
@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
@pytest.mark.filterwarnings(FORKS)
def test_a_core_held_by_another_users_rack_is_seen(first: Rack) -> None:
    def look() -> bool:
        os.setuid(65_533)
        return str(find_holders("another").get(0)).startswith(
            f"rack '{first.config.name}' (process "
        )

    assert exit_status(fork(look)) == 0


@needs_deadlines
@pytest.mark.filterwarnings(FORKS)
def test_a_task_that_has_reserved_time_is_seen_without_its_segment(
    rack_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rack.boards.crate.neighbours.list_racks", lambda: [rack_name])

    def reserve() -> None:
        take_core(0, 0, Reservation(100_000, 10_000_000))
        name_process(f"{rack_name}:wave")
        signal.pause()

    with forked(reserve) as pid:
        wait_until(lambda: find_holders("another"))
        assert find_holders("another")[0].process == f"process {pid}"


@pytest.mark.slow
@needs_fifo
@pytest.mark.parametrize("setting", ["clock.mode=lockstep", "board.wave.priority=0"])
def test_waiting_racks_hold_no_core(config: MakeConfig, first: Rack, setting: str) -> None:
    with Rack(second(config, first, "board.wave.core=0", setting), share=False) as rack:
        assert not [event for event in rack.events if event.kind == "ready"]


@pytest.mark.slow
@needs_fifo
@needs_two_cores
def test_a_board_without_a_core_setting_moves_to_a_free_core(
    config: MakeConfig, first: Rack
) -> None:
    with Rack(second(config, first, text=ELSEWHERE), share=False) as rack:
        ready = [event.text for event in rack.events if event.kind == "ready"]
        core = rack.segment.layout.find_task("wave").core
    assert core == min(os.sched_getaffinity(0) - {0})
    assert ready[0].startswith(f"wave on core {core}: rack '{first.config.name}'")


@pytest.mark.thorough
@pytest.mark.skipif(
    os.getuid() != 0 or not shutil.which("setpriv"), reason="needs to drop CAP_SYS_NICE"
)
def test_without_real_time_priority_every_view_of_a_rack_says_so(
    config: MakeConfig, tmp_path: Path
) -> None:
    path = tmp_path / "config.toml"
    path.write_text(config(*FIFO, "clock.on_no_realtime=warn", text=PLAIN).to_toml_text())
    command = ["setpriv", "--bounding-set", "-sys_nice", "--inh-caps", "-sys_nice", *RACK]
    words = ["run", str(path), "--seconds", "0.5", "--no-record", "--share"]
    done = run_to_end([*command, *words], BOUND_S, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert "SCHED_FIFO refused, ordinary scheduling for wave" in done.stderr
    assert "@GROUP - rtprio 99" in done.stderr
    assert "NO REAL-TIME PRIORITY" in done.stderr.splitlines()[-1]
