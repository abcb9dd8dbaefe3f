"""The picture of an arm shows all of it on a floor, in light, with labels of its joints alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rack.boards.config import load
from rack.levels.robot.cell import Cell, build_cell
from rack.tools.robot.picture import (
    HEIGHT,
    NO_PICTURE,
    WIDTH,
    build_camera,
    compute_axes,
    draw_arm,
    list_corners,
)

CONFIGS = Path(__file__).parents[3] / "configs"
ARMS = ["nasrem", "k1607", "penn", "hic", CONFIGS / "examples/own-arm/desk-arm.toml"]


def build(name: str | Path) -> Cell:
    """Return the cell of a config."""
    config = load(name)
    assert config.robot is not None
    return build_cell(config.robot, config.scene, config.clock_ns)


@pytest.mark.parametrize("name", ARMS)
def test_everything_is_in_the_frame_and_fills_it(name: str | Path) -> None:
    cell = build(name)
    is_drawn = np.ones(cell.model.ngeom, bool)
    points = list_corners(cell, cell.build_start_data(), is_drawn)
    fov_deg = float(cell.model.vis.global_.fovy)
    camera = build_camera(points, fov_deg)
    right, up, forward = compute_axes()
    offsets = points - (camera.lookat - camera.distance * forward)
    scale = np.tan(np.radians(fov_deg) / 2) * (offsets @ forward)
    across, along = offsets @ right / scale * HEIGHT / WIDTH, offsets @ up / scale
    assert max(np.abs(across).max(), np.abs(along).max()) < 1.0
    assert max(np.ptp(across), np.ptp(along)) > 1.2, "at least 60 % of the width or height"


def test_the_picture_has_no_dark_background(tmp_path: Path) -> None:
    if draw_arm(build("k1607"), tmp_path / "arm.png") == NO_PICTURE:
        pytest.skip(NO_PICTURE)
    pixels = np.asarray(Image.open(tmp_path / "arm.png"))
    assert pixels.shape == (HEIGHT, WIDTH, 3)
    assert pixels[0].min() > 100, "sky"
    assert (pixels.max(axis=2) < 20).mean() < 0.02, "only outlines of labels and shadows are black"
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 1000, "shading"
