"""Levels of racks that give up another one soon: importing them shortens the bound, in the crate
that forks boards."""

from __future__ import annotations

from rack.boards.lan import lockstep
from tests.boards.lan import lan_levels

lockstep.GIVE_UP_S = 0.2


class Echo(lan_levels.Echo):
    """As the other one."""
