"""Who may do what on a rack's session, as rules for zenoh's access control. What no rule allows is
denied.

A rule concerns what comes in (ingress) or goes out (egress), a kind of message, and keys. With TLS
its subject is the common name of the other side's certificate; without, there is no identity, and
rules hold for everyone: what a rack exports anybody may read then, and what it imports is known by
its key and its seal alone. Both sides of a subscription need a rule: to declare it is a message
too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from rack.boards.lan.config import LanTable
from rack.boards.lan.keys import (
    ALL_ALIVE,
    any_alive,
    estop_key,
    out_key,
    ping_key,
    pong_key,
    step_key,
)

IN = "ingress"
OUT = "egress"
SUBSCRIBE = ("declare_subscriber",)
PUT = ("put",)
TOKEN = ("liveliness_token",)
WATCH_TOKENS = ("declare_liveliness_subscriber", "liveliness_query")
ANYONE = "*"
"""Subject of rules for everyone; no rack may have this name."""


class Permission(NamedTuple):
    """Messages of some kinds under some keys, in one direction, that are allowed."""

    flow: str
    messages: Sequence[str]
    keys: Sequence[str]


def access_control(own: str, table: LanTable, is_operator: bool) -> dict[str, Any]:
    """Return zenoh's `access_control` for rack `own`, or for an operator of that name, who sets the
    emergency stop of other racks."""
    by_subject: dict[str, list[Permission]] = {}
    if is_operator:
        by_subject[ANYONE] = list(_operator(own))
    elif not table.has_tls:
        exported = [out_key(own, entry.source) for entry in table.exports.values()]
        by_subject[ANYONE] = [*_shown(own, exported), *_compared(own)]
    for peer in dict.fromkeys([*table.racks, *table.estop_from]):
        rules = by_subject.setdefault(peer if table.has_tls else ANYONE, [])
        rules += _visible(own)
        if peer in table.racks:
            rules += _exchange(own, peer, table)
        if peer in table.estop_from:
            rules += _stopped_by(own, peer)
    return _configured(by_subject)


def _exchange(own: str, peer: str, table: LanTable) -> Iterator[Permission]:
    """Yield the rules for a rack with which this one exchanges mailboxes."""
    imports = [
        out_key(peer, entry.mailbox) for entry in table.imports.values() if entry.rack == peer
    ]
    exports = [out_key(own, entry.source) for entry in table.exports.values()]
    taken = [*imports, step_key(peer), ping_key(peer, own), pong_key(peer, own)]
    given = [*exports, step_key(own), ping_key(own, peer), pong_key(own, peer)]
    yield Permission(OUT, SUBSCRIBE, [*taken, ping_key("*", own), pong_key("*", own)])
    yield Permission(IN, PUT, taken)
    yield Permission(IN, SUBSCRIBE, [ping_key("*", peer), pong_key("*", peer)])
    yield from _shown(own, given)
    yield Permission(OUT, WATCH_TOKENS, [ALL_ALIVE, any_alive(peer)])
    yield Permission(IN, TOKEN, [any_alive(peer)])


def _shown(own: str, keys: Sequence[str]) -> Iterator[Permission]:
    """Yield the rules for keys to which others may subscribe."""
    if keys:
        yield Permission(IN, SUBSCRIBE, keys)
        yield Permission(OUT, PUT, keys)
    yield from _visible(own)


def _compared(own: str) -> Iterator[Permission]:
    """Yield the rules for others that may compare their clocks with this rack's: messages of
    unknown age are no use."""
    yield Permission(OUT, SUBSCRIBE, [ping_key("*", own)])
    yield Permission(IN, PUT, [ping_key("*", own)])
    yield Permission(IN, SUBSCRIBE, [pong_key("*", "*")])
    yield Permission(OUT, PUT, [pong_key(own, "*")])


def _visible(own: str) -> Iterator[Permission]:
    """Yield the rules for others that may know that this rack is there."""
    yield Permission(IN, WATCH_TOKENS, [ALL_ALIVE, any_alive(own)])
    yield Permission(OUT, TOKEN, [any_alive(own)])


def _stopped_by(own: str, peer: str) -> Iterator[Permission]:
    """Yield the rules for a peer that may set the emergency stop."""
    yield Permission(OUT, ("declare_queryable",), [estop_key("*", own)])
    yield Permission(IN, ("query",), [estop_key(peer, own)])
    yield Permission(OUT, ("reply",), [estop_key(peer, own)])


def _operator(own: str) -> Iterator[Permission]:
    """Yield the rules for setting the emergency stop of any rack."""
    yield Permission(IN, ("declare_queryable",), [estop_key("*", "*")])
    yield Permission(OUT, ("query",), [estop_key(own, "*")])
    yield Permission(IN, ("reply",), [estop_key(own, "*")])
    yield Permission(OUT, WATCH_TOKENS, [ALL_ALIVE])
    yield Permission(IN, TOKEN, [ALL_ALIVE])


def _configured(by_subject: dict[str, list[Permission]]) -> dict[str, Any]:
    rules: list[dict[str, Any]] = []
    policies = []
    subjects = []
    for subject, allowed in by_subject.items():
        ids = [f"{subject}-{at}" for at in range(len(allowed))]
        for name, (flow, messages, keys) in zip(ids, allowed, strict=True):
            rule = {"id": name, "permission": "allow", "flows": [flow]}
            rules.append({**rule, "messages": list(messages), "key_exprs": list(keys)})
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
