"""Racks of waves for tests, and the check that they leave nothing behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rack.backplane.segment import SHM_FOLDER
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from tests.backplane.conftest import make_bus  # noqa: F401  a fixture
from tests.processes import named, wait_until

CLOCK = f"""
format = 2
name = "waves"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 2.5
mode = "lockstep"
"""
PLAIN = f"""{CLOCK}
[board.wave]
slot = 2
core = 1
rate_hz = 400
executor = "wave_levels:Wave"

[board.watch]
slot = 3
rate_hz = 50
below = "wave"
executor = "wave_levels:Watch"
ends_run = true
"""
PLANNED = PLAIN.replace(
    '"wave_levels:Wave"',
    """"wave_levels:PlannedWave"
planner = "wave_levels:GainPlanner"
coupling = "tight"
within_cycles = 4""",
)
LOOSE = ("board.wave.coupling=loose", "board.wave.planner_slot=9")
"""Settings that give the wave's planner its own board."""

NEVER = "supervision.restarts=0"
"""Setting with which the loss of a board ends the run."""

UNJUDGED = "supervision.max_missed_fraction=1"
"""Setting with which no run fails because of its lost cycles: in real time the machine may be busy,
and in lockstep a board that is killed from outside loses many of a short run."""

MakeConfig = Callable[..., RackConfig]


@pytest.fixture
def config(rack_name: str, tmp_path: Path) -> Iterator[MakeConfig]:
    """Configs of this test's own rack, with settings; checks that it leaves nothing behind."""

    def make(*settings: str, text: str = PLANNED) -> RackConfig:
        path = tmp_path / "waves.toml"
        path.write_text(text)
        return load(path, [f"name={rack_name}", UNJUDGED, *settings])

    yield make
    wait_until(lambda: not named(f"{rack_name}:"))
    assert not [path.name for path in SHM_FOLDER.iterdir() if rack_name in path.name]
