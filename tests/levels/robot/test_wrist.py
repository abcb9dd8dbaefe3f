"""The wrist sensor in a model, and what is wrong with one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.levels.errors import RobotError
from rack.levels.robot.cell import build_cell
from tests.levels.systems.force.pad import pad

CLOCK_NS = 1_000_000


def test_range_limits_and_noise_come_from_model_and_config(tmp_path: Path) -> None:
    wrist = build_cell(*pad(tmp_path, noise=0.3), CLOCK_NS).wrist
    assert wrist is not None
    assert (wrist.range, wrist.contact_limits) == ((150.0, 20.0), (60.0, 8.0))
    assert wrist.noise == (0.3, 0.03)
    assert np.array_equal(wrist.addresses, np.arange(6))


def test_bodies_beyond_the_sensor_may_touch_supports_only(tmp_path: Path) -> None:
    model = (cell := build_cell(*pad(tmp_path), CLOCK_NS)).model
    names = "pad", "flange", "table", "pedestal"
    tip, flange, table, floor = (model.geom(name).id for name in names)
    assert not cell.geoms.touch[tip, table]
    assert cell.geoms.touch[tip, floor]
    assert cell.geoms.touch[flange, table]


HAS = "in the model; it has these"
BEYOND = "is beyond the sensor's range; it must be at most"


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"force": "wrist"}, f".force: no sensor 'wrist' {HAS} force sensors: wrist_force"),
        (
            {"torque": "wrist_force"},
            ".torque: sensor 'wrist_force' is not a torque sensor; it has these torque sensors:"
            " wrist_torque",
        ),
        (
            {"sites": ("sensor", "tcp")},
            ": force and torque are sensed at two sites, 'sensor' and 'tcp', instead of one",
        ),
        ({"sites": ("base", "base")}, ": site 'base' is on a body that the arm does not move"),
        ({"reach": 0.0}, ".force: sensor 'wrist_force' has no range; set its cutoff, N"),
        ({"most_force": 151.0}, f".most_force: 151 N {BEYOND} 150"),
        ({"most_torque": 25.0}, f".most_torque: 25 N m {BEYOND} 20"),
    ],
)
def test_every_mistake_is_one_line(tmp_path: Path, changes: dict[str, Any], line: str) -> None:
    with pytest.raises(RobotError) as caught:
        build_cell(*pad(tmp_path, **changes), CLOCK_NS)
    assert str(caught.value) == f"robot.wrist{line}"
