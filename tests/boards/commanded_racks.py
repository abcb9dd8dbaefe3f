"""A rack for tests of operator commands: two levels that count."""

from __future__ import annotations

from tests.boards.conftest import CLOCK, format_board

COMMANDED = (
    CLOCK
    + format_board("upper", 2, "commanded_levels:Upper", rate_hz=50, below="lower")
    + format_board("lower", 3, "commanded_levels:Lower", core=1, rate_hz=400, above="upper")
)


def commands(*tables: str) -> str:
    """Return a setting with these commands, each as an inline table of TOML without its braces."""
    return f"command=[{', '.join(f'{{{table}}}' for table in tables)}]"
