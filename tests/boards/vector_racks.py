"""A rack for tests of several neighbours: one level above three boards of a joint, which are above
one."""

from __future__ import annotations

from tests.boards.conftest import CLOCK

NAMES = ("joint1", "joint2", "joint3")
_LISTED = '["joint1", "joint2", "joint3"]'
JOINTED = f"""{CLOCK}
[board.path]
slot = 2
rate_hz = 50
below = {_LISTED}
executor = "vector_levels:PathLevel"
budget = {{ read_ms = 0.1, process_ms = 0.5, write_ms = 0.1 }}
""" + "".join(
    f"""
[board.{name}]
slot = {3 + at}
core = {at % 2}
rate_hz = 400
above = "path"
below = "arm"
executor = "vector_levels:JointLevel"
params = {{ joint = {at} }}
budget = {{ read_ms = 0.05, process_ms = 0.2, write_ms = 0.05 }}
"""
    for at, name in enumerate(NAMES)
)
JOINTED += f"""
[board.arm]
slot = 9
core = 1
rate_hz = 400
above = {_LISTED}
executor = "vector_levels:ArmLevel"
budget = {{ read_ms = 0.1, process_ms = 0.3, write_ms = 0.05 }}
"""
