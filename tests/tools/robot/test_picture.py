"""The picture of an arm shows all of it on a floor, in light, with labels of its joints alone."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from rack.boards.config import load
from rack.boards.config.cell import build_rack_cell
from rack.tools.robot.picture import HEIGHT, NO_PICTURE, WIDTH, build_camera, draw_arm

CONFIGS = Path(__file__).parents[3] / "configs"
ARMS = ["nasrem", "k1607", "penn", "hic", CONFIGS / "examples/own-arm/desk-arm.toml"]


@pytest.mark.parametrize("name", ARMS)
def test_everything_is_in_the_frame_and_fills_it(name: str | Path) -> None:
    cell = build_rack_cell(load(name))
    model = cell.model
    data = cell.build_start_data()
    camera = build_camera(cell, data, np.ones(model.ngeom, bool))
    scene = mujoco.MjvScene(model, 5000)
    category = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, category, scene)
    view = scene.camera[0]
    signs = np.array([*product((-1, 1), repeat=3)])
    is_part = (model.geom_rbound > 0.0) & (model.geom_rbound < 1.0)
    local = model.geom_aabb[:, None, :3] + model.geom_aabb[:, None, 3:] * signs
    corners = (data.geom_xmat.reshape(-1, 1, 3, 3) @ local[..., None])[..., 0]
    offsets = (corners + data.geom_xpos[:, None])[is_part].reshape(-1, 3) - view.pos
    scale = np.tan(np.radians(model.vis.global_.fovy) / 2) * (offsets @ view.forward)
    across = offsets @ np.cross(view.forward, view.up) / scale * HEIGHT / WIDTH
    along = offsets @ view.up / scale
    assert max(np.abs(across).max(), np.abs(along).max()) < 1.0
    assert max(np.ptp(across), np.ptp(along)) > 1.0, "at least half of the width or height"


def test_the_picture_has_no_dark_background(tmp_path: Path) -> None:
    if draw_arm(build_rack_cell(load("k1607")), tmp_path / "arm.png") == NO_PICTURE:
        pytest.skip(NO_PICTURE)
    pixels = np.asarray(Image.open(tmp_path / "arm.png"))
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert pixels[0].min() > 100, "sky"
    assert (pixels.max(axis=2) < 20).mean() < 0.02, "only outlines of labels and shadows are black"
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 1000, "shading"
