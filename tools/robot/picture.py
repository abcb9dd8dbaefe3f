"""Draws an arm at home with MuJoCo, showing axes of joints, the tool and contacts."""

from __future__ import annotations

from copy import copy
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell

WIDTH = 1200
HEIGHT = 800
MAX_SHAPES = 5000
"""Upper bound for the number of shapes in a picture."""
VISUAL_FLAGS = (mujoco.mjtVisFlag.mjVIS_JOINT, mujoco.mjtVisFlag.mjVIS_CONTACTPOINT)
HIDDEN_GROUP = 5
SHOWN_GROUPS = 3
"""Number of geom groups that MuJoCo's own viewer shows. Others contain collision shapes."""
AZIMUTH_DEG = 135.0
ELEVATION_DEG = -22.0
FLOOR_BELOW_M = 0.005
"""Distance from the lowest point to an added floor, so that a fixed box can be a floor, too."""
FLOOR_COLOUR = (0.6, 0.62, 0.65, 1.0)
SKY_COLOUR = (128, 143, 158)
NO_PICTURE = "no picture: it needs OpenGL (EGL); on Debian: libegl1 libgl1-mesa-dri"


def draw_arm(cell: Cell, path: Path) -> str:
    """Draw the arm of a cell, at home, to a PNG file.

    Returns:
        The path as text, or `NO_PICTURE` without OpenGL.
    """
    model = copy(cell.model)
    data = cell.build_start_data()
    model.vis.global_.offwidth = WIDTH
    model.vis.global_.offheight = HEIGHT
    model.vis.headlight.ambient = [0.35, 0.35, 0.35]
    model.vis.headlight.diffuse = [0.4, 0.4, 0.4]
    try:
        from mujoco.egl import GLContext

        context = GLContext(WIDTH, HEIGHT)
        context.make_current()
        renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
    except (AttributeError, ImportError, RuntimeError, mujoco.FatalError):
        return NO_PICTURE
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
    # Axes and labels only for the joints of the arm and for the tool.
    model.jnt_group[:] = model.site_group[:] = HIDDEN_GROUP
    model.jnt_group[model.dof_jntid[cell.dof]] = 0
    model.site_group[cell.tool] = 0
    option = mujoco.MjvOption()
    option.flags[np.array(VISUAL_FLAGS, dtype=int)] = True
    option.frame = mujoco.mjtFrame.mjFRAME_SITE
    option.label = mujoco.mjtLabel.mjLABEL_JOINT
    is_drawn = model.geom_group < SHOWN_GROUPS
    if not is_drawn[cell.geoms.arm].any():
        option.geomgroup[:] = is_drawn[:] = True
    camera = build_camera(cell, data, is_drawn)
    scene = mujoco.MjvScene(model, MAX_SHAPES)
    categories = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, option, None, camera, categories, scene)
    if not (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any():
        floor = scene.geoms[scene.ngeom]
        size = 2.5 * camera.distance
        place = np.array([*camera.lookat[:2], find_lowest_z(data, model.geom_aabb) - FLOOR_BELOW_M])
        mujoco.mjv_initGeom(
            floor,
            mujoco.mjtGeom.mjGEOM_PLANE,
            np.array([size, size, 0.1]),
            place,
            np.eye(3).ravel(),
            np.array(FLOOR_COLOUR, np.float32),
        )
        scene.ngeom += 1
    if not model.nlight:
        light = scene.lights[0]
        light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        light.pos = camera.lookat + np.array([0.0, 0.0, camera.distance])
        light.dir = (-0.3, 0.25, -0.92)
        light.diffuse = (0.5, 0.5, 0.5)
        light.castshadow = True
        scene.nlight = 1
    pixels = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = np.zeros((HEIGHT, WIDTH), dtype=np.float32)
    window = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)
    mujoco.mjr_render(window, scene, renderer)
    mujoco.mjr_readPixels(pixels, depth, window, renderer)
    renderer.free()
    context.free()
    # Nothing is drawn there, except labels. They are unreadable on black.
    pixels[(depth == depth.max()) & (pixels == 0).all(axis=2)] = SKY_COLOUR
    Image.fromarray(pixels[::-1]).save(path, "png")
    return str(path)


def build_camera(cell: Cell, data: mujoco.MjData, is_drawn: Array) -> mujoco.MjvCamera:
    """Return a camera that shows all drawn geoms except floors and walls.

    Args:
        cell: The cell.
        data: Poses of its geoms.
        is_drawn: True for each drawn geom, shape (geoms,).
    """
    model = cell.model
    # A fixed geom that is much larger than the arm is a floor or a wall.
    size = np.linalg.norm(np.ptp(data.geom_xpos[cell.geoms.arm], axis=0))
    is_large = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_rbound > 1.5 * size)
    is_shown = is_drawn & ~is_large & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)
    centres = data.geom_xpos[is_shown]
    radii = model.geom_rbound[is_shown, None]
    camera = mujoco.MjvCamera()
    camera.azimuth = AZIMUTH_DEG
    camera.elevation = ELEVATION_DEG
    camera.lookat = ((centres - radii).min(axis=0) + (centres + radii).max(axis=0)) / 2
    # The cone of view touches the sphere around everything.
    radius = (np.linalg.norm(centres - camera.lookat, axis=1) + radii[:, 0]).max()
    camera.distance = radius / np.sin(np.radians(model.vis.global_.fovy) / 2)
    return camera


def find_lowest_z(data: mujoco.MjData, boxes: Array) -> float:
    """Return the smallest z of the boxes around all geoms, in m.

    Args:
        data: Poses of the geoms.
        boxes: Centre and half size of each box in the frame of its geom, m, shape (geoms, 6).
    """
    vertical = data.geom_xmat.reshape(-1, 3, 3)[:, 2]
    lows = (vertical * boxes[:, :3] - np.abs(vertical * boxes[:, 3:])).sum(axis=1)
    return float((data.geom_xpos[:, 2] + lows).min())
