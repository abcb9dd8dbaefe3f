"""The wrist sensor of an arm, as the model describes it: where it is, its range, and the limits on
contact."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Ints, Mask
from rack.levels.errors import RobotError
from rack.levels.robot.model import listed
from rack.levels.tables import WristConfig

KINDS = {"force": mujoco.mjtSensor.mjSENS_FORCE, "torque": mujoco.mjtSensor.mjSENS_TORQUE}
UNITS = {"force": "N", "torque": "N m"}


class Wrist(NamedTuple):
    """A force/torque sensor at a site. Forces are N, torques N m; of two values the first is the
    force's."""

    site: int
    addresses: Ints  # (6,), of its numbers in sensordata
    range: tuple[float, float]  # of each component, both ways
    most: tuple[float, float]  # of a contact: beyond it the arm stops
    noise: tuple[float, float]  # standard deviation of a component


def find_wrist(model: mujoco.MjModel, config: WristConfig | None, moved: Mask) -> Wrist | None:
    """Return the sensor on one of the bodies `moved` (nbody,) by the arm; None: there is none.
    Raises `RobotError`."""
    if config is None:
        return None
    names = {"force": config.force, "torque": config.torque}
    sensors = {key: _sensor(model, key, name) for key, name in names.items()}
    force, torque = (int(model.sensor_objid[sensor]) for sensor in sensors.values())
    if force != torque:
        sites = f"'{model.site(force).name}' and '{model.site(torque).name}'"
        raise RobotError(
            f"robot.wrist: force and torque are sensed at two sites, {sites}; one is valid"
        )
    if not moved[model.site_bodyid[force]]:
        raise RobotError(
            f"robot.wrist: site '{model.site(force).name}' is on a body that the arm does not move"
        )
    most = {"force": config.most_force, "torque": config.most_torque}
    for key, sensor in sensors.items():
        reach = float(model.sensor_cutoff[sensor])
        unit = UNITS[key]
        if not reach > 0.0:
            raise RobotError(
                f"robot.wrist.{key}: sensor '{names[key]}' has no range; give it a cutoff, {unit}"
            )
        if most[key] > reach:
            raise RobotError(
                f"robot.wrist.most_{key}: {most[key]:g} {unit} is beyond the sensor's range; at"
                f" most {reach:g} is valid"
            )
    first = model.sensor_adr[list(sensors.values())]
    ranges = model.sensor_cutoff[list(sensors.values())]
    return Wrist(
        site=force,
        addresses=(first[:, None] + np.arange(3)).ravel().astype(int),
        range=(float(ranges[0]), float(ranges[1])),
        most=(config.most_force, config.most_torque),
        noise=(config.noise, 0.1 * config.noise),
    )


def _sensor(model: mujoco.MjModel, key: str, name: str) -> int:
    """Return the id of a sensor of kind `key`. Raises `RobotError`."""
    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if found >= 0 and model.sensor_type[found] == KINDS[key]:
        return int(found)
    have = listed(
        [model.sensor(k).name for k in range(model.nsensor) if model.sensor_type[k] == KINDS[key]]
    )
    why = (
        f"sensor '{name}' is no {key} sensor" if found >= 0 else f"no sensor '{name}' in the model"
    )
    raise RobotError(f"robot.wrist.{key}: {why}; it has these {key} sensors: {have}")
