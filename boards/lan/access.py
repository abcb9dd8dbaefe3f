"""Rules for zenoh's access control on a rack's session. Anything without a rule is denied.

A rule allows kinds of messages under certain keys in one direction: ingress or egress. With TLS,
its subject is the common name of the other side's certificate. Without TLS there are no identities,
so the rules apply to everyone: anybody can read the exports of a rack, and imports are protected by
their keys and seals alone. A subscription needs a rule on both sides, because its declaration is a
message too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rack.boards.lan.config import LanTable
from rack.boards.lan.endpoint import has_tls
from rack.boards.lan.keys import (
    ALL_ALIVE,
    alive_pattern,
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
"""Subject of rules that apply to everyone. No rack can have this name."""


Rule = tuple[str, Sequence[str], Sequence[str]]
"""Direction (`IN` or `OUT`), allowed kinds of messages, and allowed keys."""


def build_access_control(rack: str, table: LanTable, is_operator: bool) -> dict[str, Any]:
    """Return zenoh's `access_control` setting for a session.

    Args:
        rack: Name of the rack, or of the operator.
        table: The `[adapter.lan]` table.
        is_operator: Whether the session belongs to an operator, who may only set emergency stops.
    """
    by_subject: dict[str, list[Rule]] = {}
    is_known = has_tls(table)
    if is_operator:
        # An operator may set the emergency stop of any rack.
        by_subject[ANYONE] = [
            (IN, ("declare_queryable",), [estop_key("*", "*")]),
            (OUT, ("query",), [estop_key(rack, "*")]),
            (IN, ("reply",), [estop_key(rack, "*")]),
            (OUT, WATCH_TOKENS, [ALL_ALIVE]),
            (IN, TOKEN, [ALL_ALIVE]),
        ]
    elif not is_known:
        exported = [out_key(rack, entry.source) for entry in table.exports.values()]
        by_subject[ANYONE] = [
            *_list_presence_rules(rack),
            *_list_export_rules(exported),
            # Let the others measure this rack's clock. They cannot use messages of unknown age.
            (OUT, SUBSCRIBE, [ping_key("*", rack)]),
            (IN, PUT, [ping_key("*", rack)]),
            (IN, SUBSCRIBE, [pong_key("*", "*")]),
            (OUT, PUT, [pong_key(rack, "*")]),
        ]
    for peer in dict.fromkeys([*table.racks, *table.estop_from]):
        rules = by_subject.setdefault(peer if is_known else ANYONE, [])
        rules += _list_presence_rules(rack)
        if peer in table.racks:
            rules += _list_exchange_rules(rack, peer, table)
        if peer in table.estop_from:
            rules += [
                (OUT, ("declare_queryable",), [estop_key("*", rack)]),
                (IN, ("query",), [estop_key(peer, rack)]),
                (OUT, ("reply",), [estop_key(peer, rack)]),
            ]
    return _build_settings(by_subject)


def _list_exchange_rules(rack: str, peer: str, table: LanTable) -> list[Rule]:
    """Return the rules for exchanging mailboxes, steps and pings with one other rack."""
    imports = [
        out_key(peer, entry.mailbox) for entry in table.imports.values() if entry.rack == peer
    ]
    exports = [out_key(rack, entry.source) for entry in table.exports.values()]
    taken = [*imports, step_key(peer), ping_key(peer, rack), pong_key(peer, rack)]
    return [
        (OUT, SUBSCRIBE, [*taken, ping_key("*", rack), pong_key("*", rack)]),
        (IN, PUT, taken),
        (IN, SUBSCRIBE, [ping_key("*", peer), pong_key("*", peer)]),
        *_list_export_rules([*exports, step_key(rack), ping_key(rack, peer), pong_key(rack, peer)]),
        (OUT, WATCH_TOKENS, [ALL_ALIVE, alive_pattern(peer)]),
        (IN, TOKEN, [alive_pattern(peer)]),
    ]


def _list_export_rules(keys: Sequence[str]) -> list[Rule]:
    """Return the rules that let others subscribe to `keys`, under which this rack sends."""
    return [(IN, SUBSCRIBE, keys), (OUT, PUT, keys)] if keys else []


def _list_presence_rules(rack: str) -> list[Rule]:
    """Return the rules that let others see the liveliness tokens of this rack."""
    return [
        (IN, WATCH_TOKENS, [ALL_ALIVE, alive_pattern(rack)]),
        (OUT, TOKEN, [alive_pattern(rack)]),
    ]


def _build_settings(by_subject: dict[str, list[Rule]]) -> dict[str, Any]:
    """Convert the rules of each subject to zenoh's `access_control` format."""
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": f"{subject}-{index}",
                "permission": "allow",
                "flows": [flow],
                "messages": list(messages),
                "key_exprs": list(keys),
            }
            for subject, allowed in by_subject.items()
            for index, (flow, messages, keys) in enumerate(allowed)
        ],
        "subjects": [
            {"id": subject}
            if subject == ANYONE
            else {"id": subject, "cert_common_names": [subject]}
            for subject in by_subject
        ],
        "policies": [
            {
                "rules": [f"{subject}-{index}" for index in range(len(allowed))],
                "subjects": [subject],
            }
            for subject, allowed in by_subject.items()
        ],
    }
