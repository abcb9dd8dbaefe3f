"""What the network may do, as the libraries are told: nothing of it changes unseen."""

from __future__ import annotations

from typing import Any

import pytest

from rack.boards.lan.access import build_access_control
from rack.boards.lan.config import LanTable
from rack.boards.lan.link import _build_settings
from tests.snapshots import Snapshots

SNAPSHOTS = Snapshots(__file__)
ENTRY = {"type": "lan_levels:PulseStatus", "max_age_ms": 100.0}
TABLES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "loopback": {"listen": ("tcp/127.0.0.1:7447",), "export": {"a": {"from": "a.status"}}},
    "beyond": {"listen": ("tcp/10.0.0.1:7447",), "insecure": True, "estop_from": ("x",)},
    "tls": {
        "listen": ("tls/10.0.0.1:7447",),
        "connect": ("tls/friend.example:7447",),
        "export": {"a": {"from": "a.status"}},
        "import": {"own": {"from": "friend/pulse.status", **ENTRY}},
        "peers": ("other",),
        "estop_from": ("x", "other"),
        "lease_ms": 300.0,
    },
}


@pytest.mark.parametrize("is_operator", [False, True])
@pytest.mark.parametrize("name", TABLES)
def test_the_session_settings_are_unchanged(name: str, is_operator: bool) -> None:
    table = LanTable.model_validate(TABLES[name])
    parts = {
        "access": build_access_control("home", table, is_operator),
        "settings": str(_build_settings("home", table, None, is_operator)),
    }
    SNAPSHOTS.check(f"{name}{', operator' if is_operator else ''}", parts)
