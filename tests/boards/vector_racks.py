"""A rack for tests of several neighbours: one level above three boards of a joint, which are above
one."""

from __future__ import annotations

from tests.boards.conftest import CLOCK, format_board

NAMES = ("joint1", "joint2", "joint3")


def _budget(read_ms: float, process_ms: float, write_ms: float) -> dict[str, float]:
    return {"read_ms": read_ms, "process_ms": process_ms, "write_ms": write_ms}


_PATH = {"rate_hz": 50, "below": NAMES, "budget": _budget(0.1, 0.5, 0.1)}
_JOINT = {"rate_hz": 400, "above": "path", "below": "arm", "budget": _budget(0.05, 0.2, 0.05)}
_ARM = {"rate_hz": 400, "above": NAMES, "budget": _budget(0.1, 0.3, 0.05)}
JOINTED = (
    CLOCK
    + format_board("path", 2, "vector_levels:PathLevel", **_PATH)
    + "".join(
        format_board(
            name, 3 + at, "vector_levels:JointLevel", core=at % 2, params={"joint": at}, **_JOINT
        )
        for at, name in enumerate(NAMES)
    )
    + format_board("arm", 9, "vector_levels:ArmLevel", core=1, **_ARM)
)
