"""Racks whose levels remember."""

from __future__ import annotations

from tests.boards.conftest import PLAIN

REMEMBERING = PLAIN.replace("wave_levels:Wave", "remembering_levels:Rememberer")
