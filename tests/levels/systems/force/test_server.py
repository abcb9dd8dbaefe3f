"""A server of force and motion, seen from its client and its boards."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, State
from rack.levels.algebra import Array
from rack.levels.messages import Error
from rack.levels.planning.ik import InverseKinematics
from rack.levels.planning.pose import make_pose
from rack.levels.systems.force.messages import ForceStatus, Mode, ServerRequest
from rack.levels.systems.force.server import ForceServer
from rack.levels.systems.trajectory.messages import MotionKind, RequestEnd
from tests.levels.systems.trajectory.rig import PERIOD_S, TrajectoryRig

DOWN = (0.0, 0.0, 1.0, 0.0)
FRAME = (0.0, 0.0, 1.0, 0.0)
"""Task frame: its z axis points down, into the surface."""
HEIGHT, STEP, EDGE = 0.80, 0.012, -0.10
"""Surface, m; from y = `EDGE` on it is lower by `STEP`."""
STIFFNESS, YIELD = 6000.0, 0.002
"""Stiffness, N/m, and velocity of the board per missing force, m/s per N."""


class ServerRig(TrajectoryRig):
    """The board follows the wanted force along z of the task frame; a struck guard stops it."""

    level_class = ForceServer
    request_type = ServerRequest
    level: ForceServer

    def __init__(self, **params: Any) -> None:
        super().__init__("penn_cell", boards=1, **params)
        self.ik = InverseKinematics(self.cell, 1)
        self.force = self.message(ForceStatus)
        self.force.sensed = -1
        self.offset = 0.0  # m, along z of the task frame
        self.floor = HEIGHT
        self.pressed: list[float] = []  # N, by cycle
        self.places: list[Array] = []  # of the tool, m, by cycle
        self.alive = True  # the client gives signs of life

    @property
    def status(self) -> Message:
        return self.written["status"]

    @property
    def mode(self) -> Mode:
        return Mode(self.status.mode)

    def comply(self, force: float = 15.0, **fields: Any) -> int:
        """Queue a COMPLY along z; return its id."""
        wanted = {"frame": FRAME, "selected": (0, 0, 1, 0, 0, 0), "wrench": (0, 0, force, 0, 0, 0)}
        return self.request(MotionKind.COMPLY, **{**wanted, **fields})

    def guard(self, force: float) -> int:
        """Queue a guard of the z axis; return its id."""
        return self.request(MotionKind.GUARD, frame=FRAME, guard=(0, 0, force, 0, 0, 0))

    def line(self, position: Any, seconds: float = 0.0) -> int:
        """Queue a straight line of the tool; return its id."""
        return self.request(MotionKind.POSE, position=position, quaternion=DOWN, segment=seconds)

    def others(self) -> dict[str, Reading]:
        return {"force": Reading(self.force, Verdict.NEW)}

    def obey(self) -> None:
        command, wanted = self.written["command"], self.written["compliance"]
        force, status = self.force, self.statuses["joints0"]
        if self.alive and not self.queue:
            self.queue.append(self.message(ServerRequest))
        before = status.target.copy()
        struck = force.struck == wanted.id and force.struck > 0
        follows = bool(command.due) and not struck and not status.stopped
        if follows:
            if status.holding:
                self.offset = 0.0
            if wanted.active and wanted.selected[2]:
                missing = wanted.wrench[2] + force.wrench[2]
                most = wanted.speed[2]
                self.offset += PERIOD_S * float(np.clip(YIELD * missing, -most, most))
            tool = self.ik.compute_tool_pose(command.position)
            lowered = make_pose(tool.position - [0.0, 0.0, self.offset], tool.quaternion)
            found = self.ik.find_nearby(lowered, before)
            assert found is not None
            status.target = found
        status.holding, status.position = not follows, status.target
        status.target_velocity = 0.0 if not follows else (status.target - before) / PERIOD_S
        place = self.ik.compute_tool_pose(status.target).position
        floor = self.floor - STEP * (place[1] > EDGE)
        press = STIFFNESS * max(0.0, floor - float(place[2]))
        force.echo, force.sensed, force.wrench[2] = wanted.id, self.tick, -press
        if wanted.guard[2] and press > wanted.guard[2]:
            force.struck, force.axis = wanted.id, 2
        self.pressed.append(press)
        self.places.append(place)


X, Y = 0.499, -0.15


def pressing(**params: float) -> ServerRig:
    """Return a rig whose tool presses on the surface."""
    rig = ServerRig(**params)
    rig.guard(4.0)
    rig.line((X, Y, HEIGHT - 0.02), 1.5)
    rig.comply()
    rig.run(4.0)
    assert rig.ends() == {1: RequestEnd.DONE, 2: RequestEnd.GUARDED, 3: RequestEnd.DONE}
    return rig


def test_compliance_is_done_when_the_force_is_as_wanted_and_keeps_it_over_an_edge() -> None:
    rig = pressing()
    assert rig.mode is Mode.FORCE
    assert abs(rig.status.wrench[2] - 15.0) < 4.5
    along = rig.line((X, EDGE + 0.05, HEIGHT), 2.0)
    rig.run(3.5)
    assert rig.ends()[along] == RequestEnd.DONE
    assert abs(rig.places[-1][1] - EDGE - 0.05) < 1e-3
    assert rig.places[-1][2] < HEIGHT - 0.012
    assert abs(rig.pressed[-1] - 15.0) < 0.5
    # Motion after it begins where the arm is, without a step.
    rig.request(MotionKind.COMPLY)  # its end
    up = rig.line((X, EDGE + 0.05, HEIGHT + 0.05), 1.0)
    rig.run(3.0)
    assert rig.ends()[up] == RequestEnd.DONE
    assert rig.mode is Mode.MOTION
    assert np.allclose(rig.places[-1], (X, EDGE + 0.05, HEIGHT + 0.05), atol=1e-4)
    assert np.abs(np.diff(rig.places, axis=0)).max() < 0.15 * PERIOD_S


def test_a_client_that_falls_silent_leaves_a_force_that_is_held_and_then_released() -> None:
    rig = pressing(silence=0.5, hold=1.0)
    wipe = rig.line((X, 0.1, HEIGHT), 8.0)
    rig.run(0.5)
    rig.alive = False
    rig.run(1.0)
    assert rig.mode is Mode.HELD
    assert rig.ends()[wipe] == RequestEnd.CANCELLED
    assert rig.status.resting
    assert abs(rig.pressed[-1] - 15.0) < 1.0
    assert (rig.status.state, rig.status.error) == (State.ERROR, Error.CLIENT)
    assert rig.status.reason == (
        "no sign of life from the client for 0.5 s: forces are held for 1 s; cancel, then go on"
    )
    # A restarted server goes on with that.
    rig.restart()
    rig.run(0.3)
    assert rig.mode is Mode.HELD
    rig.run(3.5)
    assert rig.mode is Mode.RELEASED
    assert rig.pressed[-1] < 2.0
    assert "the position is held" in rig.status.reason
    rest = rig.places[-1]
    rig.alive = True
    late = rig.line((X, Y, HEIGHT + 0.05), 1.0)
    rig.run(1.0)
    assert rig.ends()[late] == RequestEnd.REFUSED
    assert np.array_equal(rig.places[-1], rest)
    rig.request(MotionKind.CANCEL)
    up = rig.line((X, Y, HEIGHT + 0.05), 1.0)
    rig.run(3.0)
    assert rig.ends()[up] == RequestEnd.DONE
    assert (rig.mode, rig.status.reason) == (Mode.MOTION, "")


def test_a_missing_surface_ends_compliance_with_a_reason() -> None:
    rig = ServerRig(reach=1.0)
    rig.floor = 0.0
    press = rig.comply(speed=(0, 0, 0.02, 0, 0, 0))
    dropped = rig.line((X, 0.1, HEIGHT))
    rig.run(2.5)
    assert rig.ends() == {press: RequestEnd.FAILED, dropped: RequestEnd.CANCELLED}
    assert rig.status.reason == f"request {press}: axis z has not settled at 15 N for 1 s: 0 now"
    assert (rig.status.error, rig.mode) == (Error.CONTACT, Mode.MOTION)
    assert rig.places[0][2] - rig.places[-1][2] < 0.03


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"force": 200.0}, "force 200 N; permitted by the arm and its sensor: 80"),
        ({"frame": (0.5, 0, 0, 0)}, "the task frame's quaternion has length 0.5; permitted: 1"),
    ],
)
def test_an_impossible_contact_is_refused(fields: dict[str, object], why: str) -> None:
    rig = ServerRig()
    press = rig.comply(**fields)  # type: ignore[arg-type]
    rig.run(0.3)
    assert rig.ends() == {press: RequestEnd.REFUSED}
    assert rig.status.reason == f"request {press}: {why}"
    assert rig.mode is Mode.MOTION


def test_a_restarted_server_continues_with_the_same_contact() -> None:
    rig = pressing()
    along = rig.line((X, EDGE + 0.05, HEIGHT), 2.0)
    rig.run(0.5)
    before = rig.written["compliance"].id
    rig.restart()
    rig.run(3.5)
    assert rig.ends()[along] == RequestEnd.DONE
    assert (rig.written["compliance"].id, rig.mode) == (before, Mode.FORCE)
    assert abs(rig.pressed[-1] - 15.0) < 1.0
    assert rig.places[-1][1] == pytest.approx(EDGE + 0.05, abs=1e-3)
