"""The calls of a client of a server of force and motion, and the contacts of its program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import pytest
from pydantic import ValidationError

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import copy_message
from rack.levels.errors import LevelError
from rack.levels.systems.force.client import ForceMotions, ForceProgram
from rack.levels.systems.force.messages import Mode, ServerRequest, ServerStatus
from rack.levels.systems.trajectory.messages import MotionKind
from tests.levels.arms import config, context

ROBOT, SCENE = config("penn_cell")
TASK: Mapping[str, Any] = {
    "frame": {"table": {"x": [0.0, 2.0, 0.0], "z": [0.0, 0.0, -1.0]}},
    "contact": {
        "wipe": {"frame": "table", "wrench": {"z": 15.0}, "speed": {"z": 0.1}},
        "wall": {"frame": "table", "guard": {"x": 8.0, "ry": 0.5}},
    },
}
CONTEXT = context("client", (ROBOT, SCENE), task=TASK, sizes={"joints": 6})


PERMITTED = "permitted by the arm and its sensor: "


class Bus:
    """Takes requests, and a tick of the clock for every wait; both ports of a program."""

    sent = 0

    def __init__(self) -> None:
        self.tick, self.is_over = 0, False
        self.requests: list[ServerRequest] = []
        self.status = ServerStatus.zeros({"joints": 6})
        self.message = ServerRequest.zeros({"joints": 6})

    @property
    def time_s(self) -> float:
        return self.tick * CONTEXT.tick_s

    def wait(self, timeout_s: float) -> bool:
        self.tick += 20
        return True

    def read(self) -> Reading[ServerStatus]:
        return Reading(self.status, Verdict.NEW)

    def send(self) -> bool:
        self.requests.append(copy_message(self.message))
        return True

    def finish(self) -> None:
        """Do nothing."""


@pytest.fixture
def bus() -> Bus:
    return Bus()


@pytest.fixture
def arm(bus: Bus) -> ForceMotions:
    return ForceMotions(bus, bus, bus, CONTEXT)


def test_calls_become_requests(bus: Bus, arm: ForceMotions) -> None:
    arm.comply("wipe", wrench={"z": 20.0, "rx": 0.0})
    arm.guard("wall")
    arm.free()
    comply, guard, free = bus.requests
    kinds = [MotionKind.COMPLY, MotionKind.GUARD, MotionKind.COMPLY]
    assert [request.kind for request in bus.requests] == kinds
    assert comply.selected.tolist() == [0, 0, 1, 1, 0, 0]
    assert comply.wrench.tolist() == [0, 0, 20, 0, 0, 0]
    assert comply.speed.tolist() == [0, 0, 0.1, 0, 0, 0]
    assert guard.guard.tolist() == [8, 0, 0, 0, 0.5, 0]
    assert np.allclose(comply.frame, guard.frame)
    assert not free.selected.any()
    # The frame has the axes of the config.
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, guard.frame)
    assert np.allclose(axes.reshape(3, 3)[:, 0], (0, 1, 0))
    assert np.allclose(axes.reshape(3, 3)[:, 2], (0, 0, -1))
    bus.status.wrench, bus.status.mode = (0, 0, 14.5, 0, 0, 0), Mode.FORCE
    bus.status.place = (0.5, 0.1, 0.4)
    assert (arm.wrench()["z"], arm.mode(), arm.where()) == (14.5, Mode.FORCE, [0.5, 0.1, 0.4])


def test_a_wait_gives_signs_of_life(bus: Bus, arm: ForceMotions) -> None:
    request = arm.free()
    assert not arm.wait(request, until=lambda: bus.tick >= 1000)
    signs = [fields for fields in bus.requests if fields.id == 0]
    assert len(signs) == 9


@pytest.mark.parametrize(
    ("call", "contact", "changes", "message"),
    [
        ("comply", "wipe", {"wrench": {"z": 90.0}}, f"contact 'wipe': force 90 N; {PERMITTED}80"),
        ("comply", "wall", {}, "contact 'wall' has no axis of force; free() ends compliance"),
        ("guard", "wipe", {}, "contact 'wipe' guards no axis"),
        ("guard", "wood", {}, "contact 'wood' is not in [task.contact]; valid values: wipe, wall"),
        ("guard", "wall", {"guard": {"ry": 9.0}}, f"contact 'wall': torque 9 N m; {PERMITTED}8"),
        ("comply", "wipe", {"wrench": {"w": 5.0}}, "wrench.w"),
        (
            "comply",
            "wipe",
            {"speed": {"x": 0.1}},
            "contact 'wipe': axis x has a speed and no force; axes of force: z",
        ),
    ],
)
def test_an_impossible_contact_is_refused_at_once(
    bus: Bus, arm: ForceMotions, call: str, contact: str, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(LevelError) as refused:
        getattr(arm, call)(contact, **changes)
    assert str(refused.value).startswith(f"{call}: {message}")
    assert "\n" not in str(refused.value)
    assert not bus.requests


WIPE = {"frame": "table", "wrench": {"z": 60.0, "x": -60.0}}


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        ({}, "frame 'table' is not in [task.frame]; valid values: none"),
        (TASK["frame"], f"force 84.8528 N; {PERMITTED}80"),
    ],
)
def test_an_impossible_program_is_reported(frames: Any, reason: str) -> None:
    program = ForceProgram.model_validate({"frame": frames, "contact": {"wipe": WIPE}})
    found = list(program.find_mismatches(ROBOT, SCENE))
    assert [(place, why) for place, _, why in found] == [("contact.wipe", reason)]


@pytest.mark.parametrize(
    ("z", "reason"),
    [
        ([0.5, 0.0, 1.0], "its axes x and z are not at a right angle: no frame"),
        ([0.0, 0.0, 0.0], "an axis of length 0: no frame"),
    ],
)
def test_axes_that_define_no_frame_are_refused(z: list[float], reason: str) -> None:
    with pytest.raises(ValidationError, match=reason):
        ForceProgram.model_validate({"frame": {"bent": {"x": [1.0, 0.0, 0.0], "z": z}}})
