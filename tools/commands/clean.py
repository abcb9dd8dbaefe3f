"""`rack clean`: remove the shared memory that killed racks left behind."""

from __future__ import annotations

from rack.boards.crate.clean import clean as remove_leftovers
from rack.tools.console.answer import print_answer
from rack.tools.console.parameters import Json


def clean(as_json: Json = False) -> None:
    r"""Remove the shared memory that killed racks left behind.

    It never touches a rack in use, nor a directory or symbolic link that only has the name of one.

    \b
    Examples:
      rack clean
    """
    removed, in_use, strange = remove_leftovers()
    lines = [f"removed: {', '.join(removed) or 'nothing'}"]
    if in_use:
        lines.append(f"in use: {', '.join(in_use)}")
    lines += [f"left alone: {line}" for line in strange]
    print_answer({"removed": removed, "in_use": in_use, "strange": strange}, lines, as_json)
