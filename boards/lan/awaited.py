"""The rack for which an adapter waits in lockstep, in one word of its control block: for whoever
watches the rack.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum

from rack.backplane.bounded_toml import load_toml
from rack.backplane.checked import as_named, pick
from rack.backplane.errors import DamageError
from rack.backplane.segment import Segment
from rack.backplane.words import Block

GIVE_UP_S = 20.0
"""Real time after which a rack whose adapter is gone counts as lost; a restarted board is back
sooner."""
_PLACES = 8


class Why(IntEnum):
    """Why a rack is awaited."""

    UNSEEN = 0
    SLOWER = 1
    GONE = 2


_TEXTS = {
    Why.UNSEEN: "it has not come yet, or does not name this rack",
    Why.SLOWER: "it is slower, or held",
    Why.GONE: f"its adapter is gone; it counts as lost after {GIVE_UP_S:g} s",
}


def word_of(place: int, why: Why) -> int:
    """Return the word for the rack at a place among `LanTable.racks`."""
    return 1 + place + (why << _PLACES)


def awaited(segment: Segment) -> Iterator[tuple[str, str]]:
    """Yield the adapter that waits for another rack, if one does, with a text that says for which
    and why.
    """
    for task in segment.layout.tasks:
        if word := segment.block(task.name)[Block.AWAITS]:
            # Only here: it takes a while to import.
            from rack.boards.lan.config import LanTable

            why, place = divmod(word - 1, 1 << _PLACES)
            table = load_toml(segment.config).get("adapter", {}).get(task.board)
            if table is None:
                raise DamageError(f"'{task.board}' waits for another rack and is no adapter")
            keys = {field.alias or name for name, field in LanTable.model_fields.items()}
            racks = LanTable.model_validate({key: table[key] for key in keys & table.keys()}).racks
            rack = pick(racks, place, "rack")
            yield task.board, f"waits for rack '{rack}': {_TEXTS[as_named(Why, why)]}"
