"""`rack clean`: remove what killed racks left behind."""

from __future__ import annotations

from rack.tools.answer import Json, print_json


def clean(as_json: Json = False) -> None:
    """Remove what killed racks left in shared memory.

    A rack in use is never touched, nor what only has the name of one: a directory, a symbolic link.
    """
    from rack.boards.crate.clean import clean as remove

    removed, in_use, strange = remove()
    if as_json:
        print_json({"removed": removed, "in_use": in_use, "strange": strange})
        return
    print(f"removed: {', '.join(removed) or 'nothing'}")
    if in_use:
        print(f"in use: {', '.join(in_use)}")
    for line in strange:
        print(f"left alone: {line}")
