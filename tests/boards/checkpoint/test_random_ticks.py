"""From random ticks a run continues to its own digest: in the middle of motions, plans, faults,
restarts and holds."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards import Rack
from rack.boards.checkpoint.format import FOLDER, checkpoints
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.wiring import Keeping

SEED = 28
SECONDS = 7.0
EVERY = 7
"""Ticks: no task's cycle is a multiple of it, nor of those of most others."""
COUNT = 4
HOLDS = (
    "command=[{ level = 'task', what = 'hold', at = 2.0 }, { level = 'task', what = 'resume', at ="
    " 3.0 }, { level = 'servo', what = 'hold', at = 4.5 }, { level = 'servo', what = 'resume', at ="
    " 5.2 }]"
)
RUNS = {
    "plain": ((), None),
    "restarts": ((), "kill-each-board"),
    "faults": ((), "bad-sensors"),
    "holds": ((HOLDS,), None),
}


def config_of(run: str, name: str) -> RackConfig:
    """Return the config of one of RUNS, as the rack `name`."""
    settings, faults = RUNS[run]
    return load("nasrem", [f"name={name}", "clock.mode=lockstep", *settings], faults)


def outcomes(config: RackConfig, run: Path, count: int, seed: int) -> Iterator[tuple[int, bool]]:
    """Yield random ticks at which a rack was kept, and whether it went on from there as before."""
    folder = run / FOLDER
    folder.mkdir(parents=True)
    with Rack(config, keeping=Keeping(folder, EVERY)) as rack:
        expected = rack.run(SECONDS)
    going_on = Keeping(
        packages=config.python_path, faults=len(config.fault), commands=len(config.command)
    )
    found = checkpoints(run)
    for tick in random.Random(seed).sample(sorted(found), count):
        died = [
            (event.board, event.tick)
            for event in rack.events
            if event.kind == "died" and event.tick < tick
        ]
        keeping = replace(going_on, origin=found[tick], losses=tuple(died))
        with Rack(config, keeping=keeping) as other:
            again = other.run(SECONDS)
        yield tick, (again.digest, again.ticks) == (expected.digest, expected.ticks)


@pytest.mark.thorough
@pytest.mark.timeout(300)
@pytest.mark.parametrize("run", RUNS)
def test_a_run_continues_from_random_ticks(run: str, rack_name: str, tmp_path: Path) -> None:
    found = dict(outcomes(config_of(run, rack_name), tmp_path, COUNT, SEED))
    assert len(found) == COUNT
    assert all(found.values()), found
