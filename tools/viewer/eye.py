"""Where the eye stands, so that the first look shows the whole cell."""

from __future__ import annotations

import mujoco
import numpy as np
import rerun.blueprint as rrb

from rack.levels.robot.cell import Cell

DIRECTION = np.array([0.75, -0.95, 0.55])
"""From what is looked at to the eye: from the front right, a little above."""
DISTANCE = 1.75
"""In radii of what is looked at: it fills the view, a raised arm included."""
ENDLESS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)


def eye_on(cell: Cell) -> rrb.EyeControls3D:
    """Return the eye's place for a cell at its start; ground does not count."""
    model, data = cell.model, cell.start()
    geoms = np.flatnonzero(~np.isin(model.geom_type, ENDLESS))
    radii = model.geom_rbound[geoms, None]
    low = (data.geom_xpos[geoms] - radii).min(axis=0, initial=np.inf)
    high = (data.geom_xpos[geoms] + radii).max(axis=0, initial=-np.inf)
    if not np.isfinite([low, high]).all():
        low, high = model.stat.center - model.stat.extent, model.stat.center + model.stat.extent
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    position = centre + DISTANCE * radius * DIRECTION / np.linalg.norm(DIRECTION)
    return rrb.EyeControls3D(position=position.tolist(), look_target=centre.tolist(), eye_up=(0, 0, 1))
