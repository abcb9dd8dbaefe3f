"""Encoding of the rack for which an adapter waits in lockstep, so that tools can show it.

The adapter writes the rack and the reason into one word of its control block.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum

from rack.backplane.bounded_toml import load_toml
from rack.backplane.checked import select_item, to_enum
from rack.backplane.errors import DamageError
from rack.backplane.segment import Segment
from rack.backplane.words import Block

GIVE_UP_S = 20.0
"""Real time in s after which a rack whose adapter has ended is considered lost.

A restart of the adapter takes less.
"""
_PLACES = 8


class WaitReason(IntEnum):
    """Reasons for waiting for a rack."""

    UNSEEN = 0
    SLOWER = 1
    GONE = 2


_TEXTS = {
    WaitReason.UNSEEN: "it has not connected yet, or its config does not name this rack",
    WaitReason.SLOWER: "it is slower, or held",
    WaitReason.GONE: f"its adapter has ended; the rack counts as lost after {GIVE_UP_S:g} s",
}


def encode_wait(index: int, why: WaitReason) -> int:
    """Encode in one word which rack an adapter waits for and why.

    Args:
        index: Index of the rack in `LanTable.racks`.
        why: Reason for waiting.

    Returns:
        A nonzero word for `Block.AWAITS`. Zero means that the adapter does not wait.
    """
    return 1 + index + (why << _PLACES)


def find_waits(segment: Segment) -> Iterator[tuple[str, str]]:
    """Yield the board of each waiting adapter, and a text with the awaited rack and the reason.

    Raises:
        DamageError: A waiting board is not an adapter, or its word contains an invalid rack or
            reason.
    """
    for task in segment.layout.tasks:
        if word := segment.get_block(task.name)[Block.AWAITS]:
            # Imported late because the import is slow and most racks have no network.
            from rack.boards.lan.config import LanTable

            why, index = divmod(word - 1, 1 << _PLACES)
            table = load_toml(segment.config).get("adapter", {}).get(task.board)
            if table is None:
                raise DamageError(f"'{task.board}' waits for another rack and is no adapter")
            keys = {field.alias or name for name, field in LanTable.model_fields.items()}
            racks = LanTable.model_validate({key: table[key] for key in keys & table.keys()}).racks
            rack = select_item(racks, index, "rack")
            yield task.board, f"waits for rack '{rack}': {_TEXTS[to_enum(WaitReason, why)]}"
