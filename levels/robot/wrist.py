"""The wrist sensor of an arm as the model describes it, and limits on contact."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Ints, Mask
from rack.levels.errors import RobotError
from rack.levels.robot.model import format_names
from rack.levels.tables import WristConfig

SENSOR_KINDS = {
    "force": (mujoco.mjtSensor.mjSENS_FORCE, "N"),
    "torque": (mujoco.mjtSensor.mjSENS_TORQUE, "N m"),
}
"""Kinds of MuJoCo sensors, and their units."""


class Wrist(NamedTuple):
    """A force/torque sensor at a site.

    Forces are in N, torques in N m. Pairs of values are for force and torque.
    """

    site: int  # id
    addresses: Ints  # (6,), addresses of its values in sensordata
    range: tuple[float, float]  # largest value of a component, in both directions
    contact_limits: tuple[float, float]  # force and torque of a contact at which the arm stops
    noise: tuple[float, float]  # standard deviation of a component


def find_wrist(model: mujoco.MjModel, config: WristConfig | None, moved: Mask) -> Wrist | None:
    """Find the force/torque sensor at the wrist in the compiled model.

    Args:
        model: The compiled model.
        config: The `[robot.wrist]` table. None if the arm has no sensor.
        moved: Bodies that the arm moves, (nbody,).

    Returns:
        The sensor. None if the arm has none.

    Raises:
        RobotError: The sensor is missing, not on the arm, at two sites, or without a range, or a
            contact limit is beyond its range.
    """
    if config is None:
        return None
    names = (config.force, config.torque)
    sensors = [
        _find_sensor(model, key, name) for key, name in zip(SENSOR_KINDS, names, strict=True)
    ]
    force, torque = model.sensor_objid[sensors].tolist()
    if force != torque:
        raise RobotError(
            f"robot.wrist: force and torque are sensed at two sites, '{model.site(force).name}' and"
            f" '{model.site(torque).name}', instead of one"
        )
    if not moved[model.site_bodyid[force]]:
        raise RobotError(
            f"robot.wrist: site '{model.site(force).name}' is on a body that the arm does not move"
        )
    contact_limits = (config.most_force, config.most_torque)
    reaches = model.sensor_cutoff[sensors].tolist()
    for (key, (_, unit)), name, reach, limit in zip(
        SENSOR_KINDS.items(), names, reaches, contact_limits, strict=True
    ):
        if not reach > 0.0:
            raise RobotError(
                f"robot.wrist.{key}: sensor '{name}' has no range; set its cutoff, {unit}"
            )
        if limit > reach:
            raise RobotError(
                f"robot.wrist.most_{key}: {limit:g} {unit} is beyond the sensor's range; it"
                f" must be at most {reach:g}"
            )
    return Wrist(
        site=force,
        addresses=(model.sensor_adr[sensors, None] + np.arange(3)).ravel().astype(int),
        range=(reaches[0], reaches[1]),
        contact_limits=contact_limits,
        noise=(config.noise, 0.1 * config.noise),
    )


def _find_sensor(model: mujoco.MjModel, key: str, name: str) -> int:
    """Return the id of a sensor of kind `key`.

    Raises:
        RobotError: The model has no such sensor.
    """
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    is_kind = model.sensor_type == SENSOR_KINDS[key][0]
    if number >= 0 and is_kind[number]:
        return int(number)
    have = format_names([model.sensor(int(k)).name for k in np.flatnonzero(is_kind)])
    why = (
        f"sensor '{name}' is not a {key} sensor"
        if number >= 0
        else f"no sensor '{name}' in the model"
    )
    raise RobotError(f"robot.wrist.{key}: {why}; it has these {key} sensors: {have}")
