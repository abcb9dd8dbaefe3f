"""Motion is continuous and keeps the limits of every joint for any sequence of requests."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rack.levels.operator import Operation
from rack.levels.systems.trajectory.messages import MotionKind, RequestEnd
from tests.levels.systems.trajectory.rig import PERIOD_S, TrajectoryRig

changes = st.lists(st.floats(-0.8, 0.8), min_size=6, max_size=6)
requests = st.lists(
    st.tuples(changes, st.floats(0.1, 0.6), st.floats(0.0, 1.5), st.floats(0.0, 1.2)),
    min_size=2,
    max_size=4,
)
WITHIN = (1.0, 1.0, 1.0, 1.0, 0.3, 1.0)  # joint 5 is near a limit at home


@pytest.mark.slow
@given(requests, st.floats(0.1, 4.0), st.sampled_from(["cancel", "hold", "nothing"]))
@settings(max_examples=8)
def test_no_chain_of_requests_exceeds_a_limit(chain: list, at: float, what: str) -> None:
    rig = TrajectoryRig()
    acted = False
    for change, half, segment, pause in chain:
        rig.joints(np.multiply(change, WITHIN), acceleration=half, segment=segment)
        rig.run(pause)
        if not acted and rig.tick * 1e-3 > at:
            acted = True
            act(rig, what)
    act(rig, what)
    rig.run(1.0)
    act(rig, "resume")
    while rig.written["status"].done < rig.ids and rig.tick < 60_000:
        rig.cycle()
    status = rig.run(0.5)
    assert max(rig.excess()) <= 1.0
    assert status.resting
    assert not status.current
    assert status.done == rig.ids
    assert {*rig.ends().values()} <= {RequestEnd.DONE, RequestEnd.CANCELLED}


def act(rig: TrajectoryRig, what: str) -> None:
    if what == "cancel":
        rig.request(MotionKind.CANCEL)
    elif what != "nothing":
        rig.say(Operation[what.upper()])


@pytest.mark.slow
@pytest.mark.parametrize("cycles", [10, 50, 90])
def test_a_cancel_at_any_time_ramps_to_rest_and_drops_the_rest(cycles: int) -> None:
    rig = TrajectoryRig()
    first = [
        rig.joints([0.5, 0.2, 0, 0, 0, 0.5]),
        rig.joints([1.0, 0, 0.3, 0, 0.2, 0.5]),
        rig.joints([0] * 6),
    ]
    rig.run(cycles * PERIOD_S)
    before = dict(rig.ends())
    cancel = rig.request(MotionKind.CANCEL)
    after = rig.joints([0.1] * 6)
    rig.run(4.0)
    assert max(rig.excess()) <= 1.0
    ends = rig.ends()
    assert ends[cancel] == ends[after] == RequestEnd.DONE
    assert all(ends[r] == before.get(r, RequestEnd.CANCELLED) for r in first)
    assert np.allclose(rig.positions[-1] - rig.cell.home, 0.1, atol=1e-9)
