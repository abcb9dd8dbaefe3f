"""`rack list`: the racks on this machine."""

from __future__ import annotations

from rack.tools.answer import Json, print_json


def list_racks(as_json: Json = False) -> None:
    """List the racks on this machine: those that run, and those that a killed launcher left behind."""
    from rack.backplane.segment import racks
    from rack.tools.survey import describe

    found = [describe(name) for name in racks()]
    if as_json:
        print_json(found)
        return
    for rack in found:
        print(f"{rack['rack']:<24} {rack['state']:<10} {rack['detail']}")
    if not found:
        print("no racks")
