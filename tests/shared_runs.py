"""Recorded runs that several files of tests read: each is made once in a session, by the worker
that needs it first."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import pytest

from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording
from tests.conftest import SMALL

SMALL_S = 4.0
SLOW_RATES = ("board.upper.rate_hz=10", "board.lower.rate_hz=80")
"""Cycles of 40 and 5 ticks."""
SLOW_S = 5.0
LOWER_LOST_AT, CLOCK_LOST_AT = 80, 200
NASREM_S = 6.5
"""The first path is planned, and part of it driven."""


def small_run(factory: pytest.TempPathFactory) -> Path:
    """Return a copy of a run in lockstep of the small rack, `SMALL_S` long."""
    return _copy(factory, "small", SMALL_S)


def slow_run(factory: pytest.TempPathFactory) -> Path:
    """Return a copy of a run in lockstep of the small rack at `SLOW_RATES`, `SLOW_S` long."""
    return _copy(factory, "slow", SLOW_S, SLOW_RATES)


def nasrem_run(factory: pytest.TempPathFactory) -> Path:
    """Return a copy of a run in lockstep of the NASREM rack, `NASREM_S` long."""
    return _copy(factory, "nasrem", NASREM_S, ("clock.mode=lockstep",))


def faulty_run(factory: pytest.TempPathFactory) -> Path:
    """Return a copy of a run in lockstep of the small rack in which its upper board hangs at tick
    80, and another fault finds no cause to begin."""
    hang = '{ kind = "hang", board = "upper", tick = 80 }'
    idle = '{ kind = "hang", board = "lower", when = "upper.status.state == error", for = "20ms" }'
    return _copy(factory, "faulty", 3.0, [f"fault=[{hang}, {idle}]"])


def standby_run(factory: pytest.TempPathFactory) -> Path:
    """Return a copy of a run in lockstep of the small rack with standbys of both boards and of the
    clock, in which the lower board is killed at `LOWER_LOST_AT` and the clock later."""
    lower = f'{{ kind = "kill", board = "lower", tick = {LOWER_LOST_AT} }}'
    clock = f'{{ kind = "kill", board = "clock", tick = {CLOCK_LOST_AT} }}'
    places = {"board.lower": 9, "board.upper": 10, "clock": 11}
    standbys = [f"{name}.standby={{slot={slot},core=0}}" for name, slot in places.items()]
    soon = "supervision.lockstep_restart_s=0.05"
    return _copy(factory, "standby", 3.0, [*standbys, f"fault=[{lower}, {clock}]", soon])


def run_text(factory: pytest.TempPathFactory, text: str, seconds: float, *settings: str) -> Path:
    """Run the rack of a config for some time, under a name of its own; return the run's folder."""
    folder = factory.mktemp("rack")
    (folder / "rack.toml").write_text(text)
    name = f"test-{folder.name}-{os.getpid()}"
    config = load(folder / "rack.toml", [f"name={name}", *settings])
    assert run_rack(config, seconds, folder / "run", Display()).recording == "complete"
    return folder / "run"


def _copy(
    factory: pytest.TempPathFactory, name: str, seconds: float, settings: Sequence[str] = ()
) -> Path:
    """Return a copy of the run `name`: its readers write reports and pictures into the folder."""
    base = factory.getbasetemp()
    # Each worker of pytest-xdist has a folder of its own in the session's.
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    made = base / f"shared-{name}"
    with (base / f"shared-{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.is_dir():
            _run(factory.mktemp(name), name, seconds, settings).rename(made)
    return Path(shutil.copytree(made, factory.mktemp(name) / "run"))


def _run(folder: Path, name: str, seconds: float, settings: Sequence[str]) -> Path:
    config: Path | str = name
    if name != "nasrem":
        config = folder / "small.toml"
        config.write_text(SMALL)
    rack = load(config, [f"name=test-shared-{name}-{os.getpid()}", *settings])
    return record(rack, seconds, folder / "run").folder


def record(config: RackConfig, seconds: float | None, folder: Path) -> Recording:
    """Run a rack, without a limit to its own end, and return the complete recording."""
    assert run_rack(config, seconds, folder, Display()).recording == "complete"
    return Recording(folder)
