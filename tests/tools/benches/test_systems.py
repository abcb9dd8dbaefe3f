"""The bench of systems: figures of racks by config and run, whatever their levels are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards.config import load, rack_timing, wire
from rack.tools.benches.comparison import Absent
from rack.tools.benches.system_figures import HoldResponse, SystemFigures, SystemPrediction, Systems
from rack.tools.benches.systems import hold_for, prediction, systems
from tests.boards.conftest import PLAIN
from tests.boards.vector_racks import JOINTED
from tests.tools.command_line import rack

PROMISED = SystemPrediction(("top", "low"), 2, 0, 3, (50.0, 400.0), 20.0, 40.0, 22.5, 22.5, 40.0, {0: 0.5}, True)
TIMES = {"min": 20.0, "p50": 22.5, "p99": 22.5, "p99_9": 22.5, "max": 22.5}
HOLD = HoldResponse("top", "acted on", 30.0, 42.5, 31.0)
FOUND = SystemFigures("one", PROMISED, 8.0, 0.002, 0.0015, {0: 0.4}, "top", TIMES, TIMES, TIMES, TIMES, HOLD, "")


@pytest.fixture
def jointed(tmp_path: Path) -> Path:
    path = tmp_path / "jointed.toml"
    path.write_text(JOINTED)
    return path


def test_the_default_is_nasrem_and_every_bundled_rack_with_a_folder() -> None:
    assert systems()[0] == "nasrem"
    assert len(set(systems())) == len(systems())
    for name in systems():
        assert wire(load(name)).tasks


def test_what_a_config_promises_is_read_from_it_alone() -> None:
    config = load("nasrem")
    layout = wire(config)
    found = prediction(config, rack_timing(config, layout), layout)
    assert found.levels == ("task", "elemental_move", "primitive", "servo")
    assert found.rates_hz == pytest.approx((1, 4, 50, 400))
    # Slots 2 to 7, one of them a planner's; five executors, four planners and the clock.
    assert (found.boards, found.hosts, found.processes) == (6, 0, 10)
    assert (found.longest_cycle_ms, found.bound_ms, found.sum_ms) == (1000, 4000, 1272.5)
    assert found.fits
    assert set(found.loads) == {0, 1}


def test_a_rack_without_levels_above_each_other_promises_no_response(tmp_path: Path) -> None:
    path = tmp_path / "lone.toml"
    path.write_text(PLAIN.replace('below = "wave"', 'reads = { status = "wave.status" }'))
    config = load(path)
    layout = wire(config)
    found = prediction(config, rack_timing(config, layout), layout)
    assert (found.levels, found.rates_hz, found.longest_cycle_ms, found.command_ms, found.fits) == ((), (), 0, 0, None)
    assert hold_for(config, rack_timing(config, layout), layout, 10.0) is None


def test_the_highest_level_that_responds_within_the_run_is_held() -> None:
    config = load("nasrem")
    layout = wire(config)
    timing = rack_timing(config, layout)
    long, short = (hold_for(config, timing, layout, seconds) for seconds in (10.0, 2.0))
    assert long is not None
    assert (long.level, long.what, long.tick) == ("task", "hold", 2000)
    assert short is not None
    assert short.level == "elemental_move"
    assert hold_for(config, timing, layout, 0.1) is None


def test_a_rack_is_compared_by_its_runs(jointed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    pictures = tmp_path / "pictures"
    done = rack("bench", "systems", jointed, "--seconds", 1, "--share", "--json", "--plot", pictures)
    found = json.loads(done.stdout)
    (one,) = found["systems"]
    assert done.returncode == (0 if one["worked"] else 1)
    assert (one["rack"], one["failure"]) == ("jointed", "")
    assert one["predicted"]["levels"] == ["path", "joint1 ... joint3", "arm"]
    assert one["lockstep_speed"] > 0
    assert one["command_ms"]["min"] == 25.0
    # What one board writes, the next reads in the next tick, or later.
    assert (one["command_age_ms"]["min"], one["status_age_ms"]["min"]) == (2.5, 2.5)
    assert one["hold"]["level"] == "path"
    assert one["hold"]["fate"] == "acted on"
    assert one["hold"]["measured_ms"] >= 25.0
    assert [peer["who"] for peer in found["absent"]] == ["cyclictest"]
    assert all((pictures / f"systems.{kind}").stat().st_size > 1000 for kind in ("png", "svg"))


def test_a_config_with_mistakes_is_refused_before_any_rack_runs(jointed: Path, tmp_path: Path) -> None:
    done = rack("bench", "systems", jointed, tmp_path / "none.toml")
    assert done.returncode == 2
    assert "no such file" in done.stderr


def test_a_rack_fails_by_its_run_and_a_late_hold_is_named() -> None:
    failed = replace(FOUND, failure="board lost: servo")
    late = replace(FOUND, rack="late", hold=replace(HOLD, measured_ms=45.0))
    overtaken = replace(FOUND, hold=replace(HOLD, fate="overtaken", measured_ms=None))
    assert Systems((FOUND, late, overtaken), 1.0, None).worked
    assert not Systems((FOUND, failed), 1.0, None).worked
    assert list(Systems((FOUND, failed), 1.0, None).lines())[-1] == "one: board lost: servo"
    *_, last = Systems((FOUND, late), 1.0, None).lines()
    assert last == "late: the response to the hold took longer than the longest on the grid"
    queued = replace(FOUND, commanded="low")
    below = "one: down is measured from low: the wait in the queue above it does not count as response"
    assert below in Systems((queued,), 1.0, None).lines()
    assert any("overtaken" in line for line in Systems((overtaken,), 1.0, None).lines())
    assert FOUND.held
    assert replace(FOUND, missed=0.02).verdict == "1.85 % missed beyond cyclictest"


def test_the_figures_are_two_tables_and_the_chains() -> None:
    lone = replace(FOUND, rack="lone", predicted=replace(PROMISED, levels=(), rates_hz=()), command_ms=None, hold=None)
    found = Systems((FOUND, lone), 1.0, Absent("cyclictest", "no program", "apt-get install rt-tests"))
    lines = list(found.lines())
    assert "one: top > low" in lines
    assert "lone: no level above another" in lines
    rows = [line.split() for line in lines if line.startswith(("one ", "lone "))]
    assert rows[0] == ["one", "2", "2", "0", "3", "50", "400", "20", "40", "22.5", "22.5", "40", "0.50", "yes"]
    assert rows[2][:5] == ["one", "8", "0.20", "0.15", "0.05"]
    assert rows[2][-3:] == ["top", "30.0", "42.5"]
    assert rows[3][-3:] == ["-", "-", "-"]
