"""`rack check`: validate a config and show what it makes."""

from __future__ import annotations

from tools.answer import ConfigName, Faults, Json, Settings, print_json


def check(
    config: ConfigName,
    settings: Settings = [],  # noqa: B006  typer copies it
    faults: Faults = None,
    as_json: Json = False,
) -> None:
    """Validate a config and show what it makes.

    Slots, cores, rates, mailboxes with their bus addresses, and the timing that follows; or every mistake, one a line.
    """
    from boards.config import load, shared_out, wire
    from tools.inventory import Inventory

    found = load(config, settings, faults)
    inventory = Inventory.of(found, wire(found), shared_out(found))
    print_json(inventory.document()) if as_json else print(inventory.text())
