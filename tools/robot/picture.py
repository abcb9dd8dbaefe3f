"""Draws an arm at home with MuJoCo, showing axes of joints, the tool and contacts."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from rack.levels.robot.cell import Cell

WIDTH = 960
HEIGHT = 600
MAX_SHAPES = 5000
"""Upper bound for the number of shapes in a picture."""
VISUAL_FLAGS = (mujoco.mjtVisFlag.mjVIS_JOINT, mujoco.mjtVisFlag.mjVIS_CONTACTPOINT)
NO_PICTURE = "no picture: it needs OpenGL (EGL); on Debian: libegl1 libgl1-mesa-dri"


def draw_arm(cell: Cell, path: Path, data: mujoco.MjData | None = None) -> str:
    """Draw the arm of a cell to a PNG file.

    Args:
        cell: The cell.
        path: The file.
        data: State of the cell. None for the arm at home.

    Returns:
        The path as text, or `NO_PICTURE` without OpenGL.
    """
    model = cell.model
    data = data or cell.build_start_data()
    model.vis.global_.offwidth = WIDTH
    model.vis.global_.offheight = HEIGHT
    model.vis.headlight.ambient = [0.35, 0.35, 0.35]
    model.vis.headlight.diffuse = [0.6, 0.6, 0.6]
    try:
        from mujoco.egl import GLContext

        context = GLContext(WIDTH, HEIGHT)
        context.make_current()
        renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except (AttributeError, ImportError, RuntimeError, mujoco.FatalError):
        return NO_PICTURE
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
    option = mujoco.MjvOption()
    option.flags[np.array(VISUAL_FLAGS, dtype=int)] = True
    option.frame = mujoco.mjtFrame.mjFRAME_SITE
    option.label = mujoco.mjtLabel.mjLABEL_JOINT
    camera = mujoco.MjvCamera()
    joints = data.xanchor[cell.model.dof_jntid[cell.dof]]
    arm = np.vstack((joints, data.site_xpos[cell.tool]))
    camera.lookat = np.mean([arm.min(axis=0), arm.max(axis=0)], axis=0)
    camera.distance = 2.2 * float(np.linalg.norm(np.ptp(arm, axis=0))) + 0.2
    camera.azimuth = 135.0
    camera.elevation = -25.0
    scene = mujoco.MjvScene(model, MAX_SHAPES)
    categories = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, option, None, camera, categories, scene)
    pixels = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    window = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)
    mujoco.mjr_render(window, scene, renderer)
    mujoco.mjr_readPixels(pixels, None, window, renderer)
    renderer.free()
    context.free()
    Image.fromarray(pixels[::-1]).save(path, "png")
    return str(path)
