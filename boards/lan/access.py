"""Who may do what on a rack's session, as rules for zenoh's access control. What no rule allows is
denied.

A rule concerns what comes in (ingress) or goes out (egress), a kind of message, and keys. Each
sender is held to the keys that begin with its own name; to look for keys is free, as nothing comes
of it but what the other side may send. With TLS a rule's subject is the common name of the other
side's certificate; without, there is no identity, and rules hold for everyone: what a rack exports
anybody may read then, and what it imports is known by its key and its seal alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from rack.boards.lan.config import LanTable
from rack.boards.lan.keys import estop_key, ping_key

IN = "ingress"
OUT = "egress"
TOKENS = ("declare_liveliness_subscriber", "liveliness_query")
LOOK = ("declare_subscriber", *TOKENS)
SEND = ("put", "liveliness_token")
EVERY_KEY = "rack/**"
ANYONE = "*"
"""Subject of rules for everyone; no rack may have this name."""


class Permission(NamedTuple):
    """Messages of some kinds under a key expression, in one direction, that are allowed."""

    flow: str
    messages: Sequence[str]
    key: str


def access_control(own: str, table: LanTable, is_operator: bool) -> dict[str, Any]:
    """Return zenoh's `access_control` for rack `own`, or for an operator of that name, who sets the
    emergency stop of other racks."""
    by_subject: dict[str, list[Permission]] = {}
    if is_operator:
        by_subject[ANYONE] = list(_operator(own))
    elif not table.has_tls:
        by_subject[ANYONE] = list(_unknown(own))
    for peer in dict.fromkeys([*table.racks, *table.estop_from]):
        rules = by_subject.setdefault(peer if table.has_tls else ANYONE, [])
        if peer in table.racks:
            rules += _exchange(own, peer)
        if peer in table.estop_from:
            rules += _stopped_by(own, peer)
    return _configured(by_subject)


def _exchange(own: str, peer: str) -> Iterator[Permission]:
    """Yield the rules for a rack with which this one exchanges mailboxes."""
    yield Permission(OUT, LOOK, EVERY_KEY)
    yield Permission(IN, SEND, f"rack/{peer}/**")
    yield from _shown(own, LOOK, SEND)


def _shown(own: str, look: Sequence[str], send: Sequence[str]) -> Iterator[Permission]:
    """Yield the rules for others that may look for what this rack sends."""
    yield Permission(IN, look, EVERY_KEY)
    yield Permission(OUT, send, f"rack/{own}/**")


def _unknown(own: str) -> Iterator[Permission]:
    """Yield the rules for everyone where nobody has a certificate: they may compare their clocks
    with this rack's, as messages of unknown age are no use."""
    yield from _shown(own, LOOK, SEND)
    yield Permission(OUT, ("declare_subscriber",), ping_key("*", own))
    yield Permission(IN, ("put",), ping_key("*", own))


def _stopped_by(own: str, peer: str) -> Iterator[Permission]:
    """Yield the rules for a peer that may set the emergency stop."""
    yield from _shown(own, TOKENS, ("liveliness_token",))
    yield Permission(OUT, ("declare_queryable",), estop_key("*", own))
    yield Permission(IN, ("query",), estop_key(peer, own))
    yield Permission(OUT, ("reply",), estop_key(peer, own))


def _operator(own: str) -> Iterator[Permission]:
    """Yield the rules for setting the emergency stop of any rack."""
    yield Permission(OUT, TOKENS, EVERY_KEY)
    yield Permission(IN, ("liveliness_token", "declare_queryable"), EVERY_KEY)
    yield Permission(OUT, ("query",), estop_key(own, "*"))
    yield Permission(IN, ("reply",), estop_key(own, "*"))


def _configured(by_subject: dict[str, list[Permission]]) -> dict[str, Any]:
    rules: list[dict[str, Any]] = []
    policies = []
    subjects = []
    for subject, allowed in by_subject.items():
        ids = [f"{subject}-{at}" for at in range(len(allowed))]
        for name, (flow, messages, key) in zip(ids, allowed, strict=True):
            rule = {"id": name, "permission": "allow", "flows": [flow]}
            rules.append({**rule, "messages": list(messages), "key_exprs": [key]})
        policies.append({"rules": ids, "subjects": [subject]})
        known = {} if subject == ANYONE else {"cert_common_names": [subject]}
        subjects.append({"id": subject, **known})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
