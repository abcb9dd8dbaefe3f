"""Draws an arm at home with MuJoCo, showing axes of joints, the tool and contacts."""

from __future__ import annotations

from copy import copy
from itertools import product
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
MARGIN = 1.1
"""Distance of the camera, relative to the distance at which everything just fits."""
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
    joints = data.xanchor[model.dof_jntid[cell.dof]]
    points = np.vstack((joints, data.site_xpos[cell.tool], list_corners(cell, data, is_drawn)))
    camera = build_camera(points, model.vis.global_.fovy)
    scene = mujoco.MjvScene(model, MAX_SHAPES)
    categories = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, option, None, camera, categories, scene)
    if not (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any():
        floor = scene.geoms[scene.ngeom]
        size = 2.5 * camera.distance
        place = np.array([*camera.lookat[:2], points[:, 2].min() - FLOOR_BELOW_M])
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


def list_corners(cell: Cell, data: mujoco.MjData, is_drawn: Array) -> Array:
    """Return the corners of the boxes around all drawn geoms except floors and walls.

    Args:
        cell: The cell.
        data: Poses of its geoms.
        is_drawn: True for each drawn geom, shape (geoms,).

    Returns:
        The corners in m, shape (n, 3).
    """
    model = cell.model
    # A fixed geom that is much larger than the arm is a floor or a wall.
    size = np.linalg.norm(np.ptp(data.geom_xpos[cell.geoms.arm], axis=0))
    is_large = (model.body_weldid[model.geom_bodyid] == 0) & (model.geom_rbound > 1.5 * size)
    is_plane = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    is_drawn = is_drawn & ~is_large & ~is_plane
    centre, half = np.split(model.geom_aabb[is_drawn], 2, axis=1)
    signs = np.array([*product((-1, 1), repeat=3)])
    local = centre[:, None] + half[:, None] * signs
    rotation = data.geom_xmat[is_drawn].reshape(-1, 1, 3, 3)
    corners = data.geom_xpos[is_drawn, None] + (rotation @ local[..., None])[..., 0]
    return np.asarray(corners.reshape(-1, 3))


def build_camera(points: Array, height_deg: float) -> mujoco.MjvCamera:
    """Return a camera that shows all points, shape (n, 3), and is as close as possible.

    Args:
        points: The points in m, shape (n, 3).
        height_deg: Angle between the lower and the upper edge of the picture.
    """
    right, up, forward = compute_axes()
    camera = mujoco.MjvCamera()
    camera.azimuth = AZIMUTH_DEG
    camera.elevation = ELEVATION_DEG
    camera.lookat = (points.min(axis=0) + points.max(axis=0)) / 2
    tangent = np.tan(np.radians(height_deg) / 2)
    offsets = points - camera.lookat
    across = np.abs(offsets @ right) / (tangent * WIDTH / HEIGHT)
    along = np.abs(offsets @ up) / tangent
    camera.distance = MARGIN * float((np.maximum(across, along) - offsets @ forward).max())
    return camera


def compute_axes() -> Array:
    """Return the directions to the right, up and forward as seen by the camera, shape (3, 3)."""
    azimuth, elevation = np.radians((AZIMUTH_DEG, ELEVATION_DEG))
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = np.cos(elevation) * level + np.array([0.0, 0.0, np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    return np.array([right, np.cross(right, forward), forward])
