"""`rack clean`: remove the shared memory that killed racks left behind."""

from __future__ import annotations

from rack.boards.crate.clean import clean as remove_leftovers
from rack.tools.console.answer import Json, print_json


def clean(as_json: Json = False) -> None:
    """Remove the shared memory that killed racks left behind.

    Never touches a rack in use, nor a directory or symbolic link that only has the name of one.

    \b
    Examples:
      rack clean
    """
    removed, in_use, strange = remove_leftovers()
    if as_json:
        print_json({"removed": removed, "in_use": in_use, "strange": strange})
        return
    print(f"removed: {', '.join(removed) or 'nothing'}")
    if in_use:
        print(f"in use: {', '.join(in_use)}")
    for line in strange:
        print(f"left alone: {line}")
