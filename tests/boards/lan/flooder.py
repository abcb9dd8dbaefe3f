"""A rack that floods: `python -m tests.boards.lan.flooder NAME ENDPOINT VICTIM` sends what is no
message, all the time.

It is there as any rack is, and floods its mailbox `pulse.status`; of `calm.status` it sends a
proper message now and then. It ends with its stdin.
"""

from __future__ import annotations

import select
import sys
import time

from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.message import Message
from rack.boards.config.layout import build_field_specs
from rack.boards.lan.config import LanTable
from rack.boards.lan.envelope import Envelope, compute_kind
from rack.boards.lan.keys import out_key
from rack.boards.lan.link import LanLink
from tests.boards.lan.lan_levels import PulseStatus

LAUNCH = 7
CALM_NS = 20_000_000
"""Time between two messages that are not part of the flood."""
BURST = 64


def main(name: str, endpoint: str, victim: str) -> None:
    exports = {port: {"from": f"{port}.status"} for port in ("pulse", "calm")}
    table = {"connect": (endpoint,), "peers": (victim,), "export": exports}
    link = LanLink(name, LanTable.model_validate(table))
    flood, calm = (link.publish(out_key(name, f"{port}.status")) for port in ("pulse", "calm"))
    kind = PulseStatus.message_type
    dtype = build_message_dtype(build_field_specs(kind, {}), kind.build_dtype({}).itemsize)
    message, code, number, due = Message(dtype), compute_kind("pulse", 1, dtype), 0, 0
    link.declare_token(LAUNCH)
    while not select.select([sys.stdin], [], [], 0)[0]:
        for at in range(BURST):
            flood(bytes(at), b"flood")
        if (now := time.monotonic_ns()) >= due:
            number, due, message.count = number + 1, now + CALM_NS, number
            payload = bytes(message.raw)
            head = Envelope(code, LAUNCH, number, number, 0, 0, now)
            calm(payload, link.sealer.seal(out_key(name, "calm.status"), head, payload))
    link.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
