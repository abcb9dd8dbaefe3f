"""Tests what a message of ROS 2 becomes, and what a model becomes in Foxglove, without a rack."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import mujoco
import pytest

from rack.tools.bridges.scene import build_scene
from rack.tools.bridges.trajectory import MAX_BYTES, TYPE, read_trajectory
from rack.tools.bridges.zenoh_node import build_key
from rack.tools.ecosystem.ros_messages import STORE, build

JOINTS = ("a", "b")
MODEL = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body name="arm" pos="0 0 1">
      <joint type="hinge"/>
      <geom type="box" size="1 2 2" rgba="1 0 0 0.5"/>
      <geom type="sphere" size="0.5"/>
      <geom type="capsule" size="0.1 0.4"/>
      <geom type="mesh" mesh="wedge"/>
      <geom type="box" size="9 9 9" group="3"/>
    </body>
  </worldbody>
</mujoco>
"""


def encode(
    names: Sequence[str],
    *points: tuple[float, Sequence[float]],
    velocities: Sequence[float] = (),
    accelerations: Sequence[float] = (),
    effort: Sequence[float] = (),
) -> bytes:
    """Encode a trajectory."""
    import numpy as np

    header = build("std_msgs/msg/Header", build("builtin_interfaces/msg/Time", 0, 0), "")
    others = [np.array(values, float) for values in (velocities, accelerations, effort)]
    made = [
        build(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            np.array(positions, float),
            *others,
            build("builtin_interfaces/msg/Duration", int(at // 1), round(at % 1 * 1e9)),
        )
        for at, positions in points
    ]
    return bytes(STORE.serialize_cdr(build(TYPE, header, [*names], made), TYPE))


def test_points_are_in_the_order_of_the_arm() -> None:
    points = read_trajectory(encode(("b", "a"), (0.5, (2, 1)), (1.25, (4, 3))), JOINTS)
    assert points == ([(0.5, [1.0, 2.0]), (1.25, [3.0, 4.0])], [])
    assert read_trajectory(encode(JOINTS), JOINTS) == ([], [])


def test_values_that_are_not_followed_are_named() -> None:
    moving = encode(JOINTS, (1, (0, 0)), velocities=(0.0, 0.5), accelerations=(1.0, 0.0))
    assert read_trajectory(moving, JOINTS).ignored == ["velocities", "accelerations"]
    # A trajectory that only asks for rest at its points asks for nothing that is ignored.
    assert read_trajectory(encode(JOINTS, (1, (0, 0)), effort=(0, 0)), JOINTS).ignored == []


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "0 bytes are not a trajectory_msgs/msg/JointTrajectory"),
        (encode(JOINTS, (1, (0, 0)))[:-9], "bytes are not a trajectory_msgs"),
        (encode(JOINTS) + b"more", "bytes are not a trajectory_msgs"),
        (b"\0\1\0\0" + b"\xff" * 40, "44 bytes are not a trajectory_msgs"),
        (bytes(MAX_BYTES + 1), f"{MAX_BYTES + 1} bytes; valid: up to {MAX_BYTES}"),
        (encode(("a",)), 'joint_names = "a": must be a, b, in any order'),
        (encode(("a", "a")), 'joint_names = "a, a": must be a, b'),
        (encode(("a", "b", "c")), "must be a, b"),
        (encode(JOINTS, (1, (0,))), "points[0].positions has length 1: must be 2"),
        (
            encode(JOINTS, (1, (0, 0)), velocities=(1.0,)),
            "points[0].velocities has length 1: must be 2",
        ),
        (encode(JOINTS, (1, (0, 0)), (1, (0, 0))), "points[1].time_from_start = 1 s: must rise"),
        (encode(JOINTS, (-1, (0, 0))), "points[0].time_from_start = -1 s: must rise from 0"),
    ],
)
def test_a_wrong_message_is_refused_with_its_place(data: bytes, why: str) -> None:
    with pytest.raises(ValueError, match=re.escape(why)):
        read_trajectory(data, JOINTS)


def test_a_key_has_the_names_of_rmw_zenoh() -> None:
    assert build_key("sensor_msgs/msg/JointState") == (
        "sensor_msgs::msg::dds_::JointState_/"
        "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
    )


def test_visible_geoms_become_primitives_in_the_frames_of_their_bodies() -> None:
    scene: Any = build_scene(mujoco.MjModel.from_xml_string(MODEL))
    text = repr(scene)
    assert text.count('frame_id: "arm"') == 4
    assert text.count('frame_id: "world"') == 1
    assert text.count("CubePrimitive {") == 2
    assert "size: Some(Vector3 { x: 4.0, y: 4.0, z: 0.0 })" in text
    assert "size: Some(Vector3 { x: 2.0, y: 4.0, z: 4.0 })" in text
    for primitive in ("SpherePrimitive {", "CylinderPrimitive {", "TriangleListPrimitive {"):
        assert text.count(primitive) == 1
