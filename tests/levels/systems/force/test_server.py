"""A server of force and motion, seen from its client and its boards."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.messages import Error
from rack.levels.systems.force.messages import Mode
from rack.levels.systems.trajectory.messages import MotionKind, RequestEnd
from tests.levels.systems.force.server_rig import EDGE, HEIGHT, PERIOD_S, ServerRig

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
    rig.free()
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
        (
            {"frame": (0.5, 0.0, 0.0, 0.0)},
            "the task frame's quaternion has length 0.5; permitted: 1",
        ),
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
