"""Racks whose levels remember."""

from __future__ import annotations

from tests.boards.conftest import CLOCK

REMEMBERING = f"""{CLOCK}
[board.wave]
slot = 2
rate_hz = 400
executor = "remembering_levels:Rememberer"

[board.watch]
slot = 3
rate_hz = 50
below = "wave"
executor = "wave_levels:Watch"
ends_run = true
"""
