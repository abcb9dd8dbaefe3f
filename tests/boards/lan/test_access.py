"""Access control: which messages under which keys the rules allow, and to whom. Nothing of what the
libraries are told changes unseen."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import pytest

from rack.boards.lan.access import (
    IN,
    OUT,
    PUT,
    SUBSCRIBE,
    TOKEN,
    WATCH_TOKENS,
    build_access_control,
)
from rack.boards.lan.config import LanTable
from rack.boards.lan.keys import alive_key, parse_alive_key
from rack.boards.lan.link import _build_settings
from tests.snapshots import Snapshots

TLS, TCP = "tls/10.0.0.1:7447", "tcp/127.0.0.1:7447"
QUERIES = ("query", "reply")
ENTRY = {"type": "lan_levels:PulseStatus", "max_age_ms": 100.0}


def rules(
    endpoint: str, is_operator: bool = False, **table: Any
) -> Iterator[tuple[str, str, str, str]]:
    """Yield flow, message, key and common name (* for anyone) of all that is allowed."""
    found = build_access_control(
        "home", LanTable.model_validate({"listen": (endpoint,), **table}), is_operator
    )
    assert (found["enabled"], found["default_permission"]) == (True, "deny")
    subjects = {
        subject["id"]: subject.get("cert_common_names", ["*"]) for subject in found["subjects"]
    }
    by_id = {rule["id"]: rule for rule in found["rules"]}
    assert len(by_id) == len(found["rules"])
    for policy in found["policies"]:
        for rule in map(by_id.__getitem__, policy["rules"]):
            assert rule["permission"] == "allow"
            for subject in policy["subjects"]:
                yield from product(
                    rule["flows"], rule["messages"], rule["key_exprs"], subjects[subject]
                )


def test_without_tls_rules_are_for_anyone_and_over_tls_each_is_for_one_certificate() -> None:
    found = list(rules(TCP))
    assert {message for _, message, *_ in found} == {*WATCH_TOKENS, *TOKEN, *SUBSCRIBE, *PUT}
    keys = {key for _, message, key, _ in found if message in (*SUBSCRIBE, *PUT)}
    assert keys == {"rack/*/ping/home", "rack/*/pong/*", "rack/home/pong/*"}
    tables: dict[str, Any] = {
        "export": {"pulse": {"from": "pulse.status"}},
        "estop_from": ["anyone"],
        "peers": ("friend",),
    }
    assert {name for *_, name in rules(TLS, **tables)} == {"friend", "anyone"}
    assert {name for *_, name in rules(TCP, **tables)} == {"*"}
    # They are the same but for what anyone may do.
    known, unknown = ({rule[:3] for rule in rules(at, **tables)} for at in (TLS, TCP))
    assert known <= unknown
    assert unknown - known <= {rule[:3] for rule in found}


def test_puts_come_from_a_rack_itself_and_only_what_is_imported() -> None:
    imports = {"import": {"own": {"from": "friend/pulse.status", **ENTRY}}}
    found = rules(TLS, **imports, peers=("other",), estop_from=["viewer"])
    puts = {(key, name) for flow, message, key, name in found if (flow, message) == (IN, "put")}
    keys = ("step", "ping/home", "pong/home")
    expected = {(f"rack/{name}/{key}", name) for name in ("friend", "other") for key in keys}
    assert puts == {*expected, ("rack/friend/out/pulse/status", "friend")}


def test_what_goes_out_is_this_racks_own() -> None:
    exports = {"pulse": {"from": "pulse.status"}}
    out = [
        key
        for flow, message, key, _ in rules(TLS, export=exports, peers=("friend",))
        if flow == OUT and message in (*PUT, *TOKEN, *QUERIES)
    ]
    assert out
    assert all(key.startswith("rack/home/") for key in out)
    assert "rack/home/out/pulse/status" in out


def test_an_operator_with_the_right_to_stop_has_no_other_right() -> None:
    stop = "rack/viewer/estop/home"
    seen = ("rack/*/alive/*", "rack/home/alive/*")
    assert {rule[:3] for rule in rules(TLS, estop_from=["viewer"])} == {
        *((IN, watch, key) for watch in WATCH_TOKENS for key in seen),
        (OUT, "liveliness_token", "rack/home/alive/*"),
        (OUT, "declare_queryable", "rack/*/estop/home"),
        (IN, "query", stop),
        (OUT, "reply", stop),
    }


@pytest.mark.parametrize("cycle_ns", [0, 20_000_000])
def test_a_token_names_launch_and_cycle(cycle_ns: int) -> None:
    assert parse_alive_key(alive_key("home", 0xAB, cycle_ns)) == (0xAB, cycle_ns)


@pytest.mark.parametrize(
    "launch", ["x", "ab", "-20", f"{1:016x}-", f"{1:016x}-x", f"{1:016x}-{10**18}", f"{1:017x}"]
)
def test_a_token_that_no_adapter_declares_is_not_parsed(launch: str) -> None:
    assert parse_alive_key(f"rack/home/alive/{launch}") is None


SNAPSHOTS = Snapshots(__file__)
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
