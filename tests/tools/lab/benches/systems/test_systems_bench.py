"""The bench of systems: figures of racks by config and run, whatever their levels are."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rack.boards.config import load, wire
from rack.tools.lab.benches.systems.bench import systems
from rack.tools.lab.benches.systems.figures import prediction
from rack.tools.lab.benches.systems.hold import hold_for
from tests.boards.conftest import PLAIN
from tests.boards.vector_racks import JOINTED, NAMES
from tests.tools.command_line import rack


@pytest.fixture
def jointed(tmp_path: Path) -> Path:
    path = tmp_path / "jointed.toml"
    path.write_text(JOINTED)
    return path


@pytest.mark.slow
def test_the_default_is_nasrem_and_every_bundled_rack_with_a_folder() -> None:
    assert systems()[0] == "nasrem"
    assert len(set(systems())) == len(systems())
    for name in systems():
        assert wire(load(name)).tasks


def test_what_a_config_promises_is_read_from_it_alone() -> None:
    config = load("nasrem")
    found = prediction(config)
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
    found = prediction(config)
    assert (found.levels, found.rates_hz, found.longest_cycle_ms, found.command_ms, found.fits) == (
        (),
        (),
        0,
        0,
        None,
    )
    assert hold_for(config, 10.0) is None


def test_the_highest_level_that_responds_within_the_run_is_held() -> None:
    config = load("nasrem")
    long, short = (hold_for(config, seconds) for seconds in (10.0, 2.0))
    assert long is not None
    assert (long.level, long.what, long.tick) == ("task", "hold", 2000)
    assert short is not None
    assert short.level == "elemental_move"
    assert hold_for(config, 0.1) is None


@pytest.mark.thorough
@pytest.mark.alone
def test_a_rack_is_compared_by_its_runs(
    jointed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    pictures = tmp_path / "pictures"
    done = rack(
        "bench", "systems", jointed, "--seconds", 1, "--share", "--json", "--plot", pictures
    )
    found = json.loads(done.stdout)
    (one,) = found["systems"]
    assert done.returncode == (0 if one["worked"] else 1)
    assert (one["rack"], one["failure"], one["poses"]) == ("jointed", "", None)
    assert one["predicted"]["levels"] == ["path", "joint1 ... joint3", "arm"]
    ran = one["realtime"]
    assert ran["command_ms"]["min"] == 25.0
    # What one board writes, the next reads in the next tick, or later.
    assert (ran["command_age_ms"]["min"], ran["status_age_ms"]["min"]) == (2.5, 2.5)
    assert ran["hold"]["level"] == "path"
    assert ran["hold"]["fate"] == "acted on"
    assert ran["hold"]["measured_ms"] >= 25.0
    assert set(ran["bus"]) == set(ran["board_loads"]) == {"path", *NAMES, "arm"}
    # A board of a joint reads a command and a status in each of at most 400 cycles a second, and
    # writes at least as much.
    assert all(ran["bus"][name]["accesses"] > 400 for name in NAMES)
    assert sum(ran["board_loads"].values()) == pytest.approx(sum(ran["loads"].values()))
    assert ran["plans"] == []
    assert [peer["who"] for peer in found["absent"]] == ["cyclictest"]
    assert all((pictures / f"systems.{kind}").stat().st_size > 1000 for kind in ("png", "svg"))
    kills = {kill["board"]: kill for kill in one["kills"]["detections"]}
    assert set(kills) == {"path", *NAMES, "arm", "clock"}
    assert one["kills"]["speed"] > 0
    # In lockstep the clock waits for the end of what it killed; a message is stale after four of
    # its writer's cycles.
    assert {kill["rack"] for kill in kills.values()} == {0}
    assert {kills[name]["by"] for name in NAMES} == {"arm"}
    assert all(3 <= kills[name]["neighbour"] <= 5 for name in (*NAMES, "arm"))


def test_a_config_with_mistakes_is_refused_before_any_rack_runs(
    jointed: Path, tmp_path: Path
) -> None:
    done = rack("bench", "systems", jointed, tmp_path / "none.toml")
    assert done.returncode == 2
    assert "no such file" in done.stderr
