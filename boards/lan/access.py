"""Who may do what on a rack's session, as rules for zenoh's access control. What no rule allows is
denied.

A rule concerns what comes in (ingress) or goes out (egress), a kind of message, and keys. With TLS
its subject is the common name of the other side's certificate; without, there is no identity, and
rules hold for everyone: what a rack exports anybody may read then, and what it imports is known by
its key and its seal alone. Both sides of a subscription need a rule: to declare it is a message
too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rack.boards.lan.config import LanTable
from rack.boards.lan.endpoint import has_tls
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


Rule = tuple[str, Sequence[str], Sequence[str]]
"""Messages of some kinds under some keys, in one direction, that are allowed."""


def access_control(own: str, table: LanTable, is_operator: bool) -> dict[str, Any]:
    """Return zenoh's `access_control` for rack `own`, or for an operator of that name, who sets the
    emergency stop of other racks.
    """
    by_subject: dict[str, list[Rule]] = {}
    is_known = has_tls(table)
    if is_operator:
        # It may set the emergency stop of any rack.
        by_subject[ANYONE] = [
            (IN, ("declare_queryable",), [estop_key("*", "*")]),
            (OUT, ("query",), [estop_key(own, "*")]),
            (IN, ("reply",), [estop_key(own, "*")]),
            (OUT, WATCH_TOKENS, [ALL_ALIVE]),
            (IN, TOKEN, [ALL_ALIVE]),
        ]
    elif not is_known:
        exported = [out_key(own, entry.source) for entry in table.exports.values()]
        by_subject[ANYONE] = [
            *_visible(own),
            *_shown(exported),
            # Others may compare their clocks with this rack's: messages of unknown age are no use.
            (OUT, SUBSCRIBE, [ping_key("*", own)]),
            (IN, PUT, [ping_key("*", own)]),
            (IN, SUBSCRIBE, [pong_key("*", "*")]),
            (OUT, PUT, [pong_key(own, "*")]),
        ]
    for peer in dict.fromkeys([*table.racks, *table.estop_from]):
        rules = by_subject.setdefault(peer if is_known else ANYONE, [])
        rules += _visible(own)
        if peer in table.racks:
            rules += _exchange(own, peer, table)
        if peer in table.estop_from:
            rules += [
                (OUT, ("declare_queryable",), [estop_key("*", own)]),
                (IN, ("query",), [estop_key(peer, own)]),
                (OUT, ("reply",), [estop_key(peer, own)]),
            ]
    return _configured(by_subject)


def _exchange(own: str, peer: str, table: LanTable) -> list[Rule]:
    """Return the rules for a rack with which this one exchanges mailboxes."""
    imports = [
        out_key(peer, entry.mailbox) for entry in table.imports.values() if entry.rack == peer
    ]
    exports = [out_key(own, entry.source) for entry in table.exports.values()]
    taken = [*imports, step_key(peer), ping_key(peer, own), pong_key(peer, own)]
    return [
        (OUT, SUBSCRIBE, [*taken, ping_key("*", own), pong_key("*", own)]),
        (IN, PUT, taken),
        (IN, SUBSCRIBE, [ping_key("*", peer), pong_key("*", peer)]),
        *_shown([*exports, step_key(own), ping_key(own, peer), pong_key(own, peer)]),
        (OUT, WATCH_TOKENS, [ALL_ALIVE, any_alive(peer)]),
        (IN, TOKEN, [any_alive(peer)]),
    ]


def _shown(keys: Sequence[str]) -> list[Rule]:
    """Return the rules for keys to which others may subscribe."""
    return [(IN, SUBSCRIBE, keys), (OUT, PUT, keys)] if keys else []


def _visible(own: str) -> list[Rule]:
    """Return the rules for others that may know that this rack is there."""
    return [(IN, WATCH_TOKENS, [ALL_ALIVE, any_alive(own)]), (OUT, TOKEN, [any_alive(own)])]


def _configured(by_subject: dict[str, list[Rule]]) -> dict[str, Any]:
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": f"{subject}-{at}",
                "permission": "allow",
                "flows": [flow],
                "messages": list(messages),
                "key_exprs": list(keys),
            }
            for subject, allowed in by_subject.items()
            for at, (flow, messages, keys) in enumerate(allowed)
        ],
        "subjects": [
            {"id": subject}
            if subject == ANYONE
            else {"id": subject, "cert_common_names": [subject]}
            for subject in by_subject
        ],
        "policies": [
            {"rules": [f"{subject}-{at}" for at in range(len(allowed))], "subjects": [subject]}
            for subject, allowed in by_subject.items()
        ],
    }
