"""A rack for tests of operator commands: two levels that count."""

from __future__ import annotations

from tests.boards.conftest import CLOCK

COMMANDED = f"""{CLOCK}
[board.upper]
slot = 2
rate_hz = 50
below = "lower"
executor = "commanded_levels:Upper"

[board.lower]
slot = 3
core = 1
rate_hz = 400
above = "upper"
executor = "commanded_levels:Lower"
"""


def commands(*tables: str) -> str:
    """Return a setting with these commands, each as an inline table of TOML without its braces."""
    return f"command=[{', '.join(f'{{{table}}}' for table in tables)}]"
