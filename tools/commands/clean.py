"""`rack clean`: remove the shared memory that killed racks left behind."""

from __future__ import annotations

from rack.boards.crate.clean import remove_dead_racks
from rack.tools.console.answer import print_answer
from rack.tools.console.parameters import Json


def clean(as_json: Json = False) -> None:
    """Remove the shared memory that killed racks left behind.

    Racks in use are not touched, and neither are directories or symbolic links named like a rack.

    \b
    Examples:
      rack clean
    """
    removed, in_use, strange = remove_dead_racks()
    lines = [f"removed: {', '.join(removed) or 'nothing'}"]
    if in_use:
        lines.append(f"in use: {', '.join(in_use)}")
    lines += [f"left alone: {line}" for line in strange]
    print_answer({"removed": removed, "in_use": in_use, "strange": strange}, lines, as_json)
