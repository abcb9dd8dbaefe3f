"""Disturb a drive of `can-arm`, or its cable, while the rack runs.

python disturb.py NODE unplugged|bus_off|late|lost|doubled|too_hot|reset [SECONDS [SIZE]]
"""

import sys

import wire
from cable import Disturbance

node, kind, seconds, size = [*sys.argv[1:], "0.2", "0.5"][:4]
with wire.open_bus() as bus:
    span = wire.SPAN.pack(Disturbance[kind.upper()], float(seconds), float(size))
    wire.send(bus, wire.DISTURB, int(node), span)
