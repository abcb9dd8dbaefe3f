"""`rack list`: the racks on this machine."""

from __future__ import annotations

from tools.answer import Json, print_json


def list_racks(as_json: Json = False) -> None:
    """List the racks on this machine: those that run, and those that a killed launcher left behind."""
    from backplane.segment import racks
    from tools.survey import describe

    found = [describe(name) for name in racks()]
    if as_json:
        print_json(found)
        return
    for rack in found:
        print(f"{rack['rack']:<24} {rack['state']:<10} {rack['detail']}")
    if not found:
        print("no racks")
