"""Every shipped rack continues from its checkpoints bit for bit, or says why it has none."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards import Rack
from rack.boards.checkpoint.format import FOLDER, checkpoints
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.errors import CheckpointError
from rack.boards.wiring import Keeping
from rack.tools.lab.benches.observed import record
from rack.tools.live.continued import beginning
from rack.tools.live.display import Display
from rack.tools.live.launch import run_rack
from tests import golden

EVERY_S = 1.5
WITHOUT = ("chimera", "condor", "ibm", "penn")
"""Racks with programs on the host side, whose state nobody can copy."""
HOSTED_S = 3.0
RUNS = [run for run in golden.RUNS if not run.startswith(WITHOUT)]


def rack_of(run: str, name: str) -> tuple[RackConfig, float | None]:
    """Return the config of a golden run, as the rack `name`, and how long it lasts."""
    words = shlex.split(run)
    options = dict(zip(words[1::2], words[2::2], strict=True))
    place = golden.FILE.parents[1] / words[0]
    settings = [f"name={name}", "clock.mode=lockstep", *options.get("--set", "").split()]
    found = place if place.is_file() else words[0]
    seconds = options.get("--seconds")
    config = load(found, settings, options.get("--faults"))
    return config, None if seconds is None else float(seconds)


@pytest.mark.thorough
@pytest.mark.timeout(480)  # four runs
@pytest.mark.parametrize("run", RUNS)
def test_a_shipped_rack_continues_from_its_checkpoints(
    run: str, rack_name: str, tmp_path: Path
) -> None:
    config, seconds = rack_of(run, rack_name)
    folder = tmp_path / FOLDER
    folder.mkdir()
    every = round(min(EVERY_S, (seconds or 1e3) / 3) * 1e9 / config.clock_ns)
    with Rack(config, keeping=Keeping(folder, every)) as rack:
        expected = rack.run(seconds)
    assert expected.digest == golden.read()["digests"][run]
    found = checkpoints(tmp_path)
    assert len(found) >= 2
    going_on = Keeping(
        packages=config.python_path, faults=len(config.fault), commands=len(config.command)
    )
    for tick in {min(found), sorted(found)[len(found) // 2], max(found)}:
        with Rack(config, keeping=replace(going_on, origin=found[tick])) as rack:
            again = rack.run(seconds)
        assert (again.digest, again.ticks) == (expected.digest, expected.ticks), f"from {tick}"


@pytest.mark.slow
@pytest.mark.parametrize("system", WITHOUT)
def test_a_rack_with_programs_on_the_host_side_is_refused_by_their_names(
    system: str, rack_name: str, tmp_path: Path
) -> None:
    config, _ = rack_of(system, rack_name)
    with pytest.raises(CheckpointError, match=r"has no checkpoints: '.*': a host program's state"):
        Rack(config, keeping=Keeping(tmp_path, 100)).launch()


@pytest.mark.thorough
@pytest.mark.timeout(240)  # three runs
@pytest.mark.parametrize("system", WITHOUT)
def test_a_shipped_rack_with_host_programs_continues_with_what_they_sent(
    system: str, rack_name: str, tmp_path: Path
) -> None:
    config, _ = rack_of(system, rack_name)
    one = record(config, HOSTED_S, tmp_path / "one")
    two = tmp_path / "two"
    with beginning(config, f"{tmp_path / 'one'}@{HOSTED_S / 2}") as begins:
        again = run_rack(config, HOSTED_S, two, Display(), begins=begins)
    assert again.outcome.digest == one.result.outcome.digest
