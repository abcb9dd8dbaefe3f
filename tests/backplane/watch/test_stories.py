"""Message faults under every protocol and at several rates have their recorded effects."""

from __future__ import annotations

import pytest

from rack.backplane.layout import PROTOCOLS, Protocol
from tests.link import MakeLink, story
from tests.snapshots import Snapshots

SNAPSHOTS = Snapshots(__file__)
ENDS = (
    ((1, 1), True),
    ((1, 1), False),
    ((4, 1), True),
    ((2, 4), False),
    ((1, 8), True),
    ((1, 8), False),
)
"""Rates of writer and reader, and whether the reader comes first."""
FAULTS: dict[str, tuple[float, ...]] = {
    "mute": (),
    "drop": (0.4,),
    "delay": (),
    "reorder": (0.4,),
    "corrupt": (0.4,),
    "babble": (),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_the_recorded_fault_story_of_a_link_is_unchanged(
    link: MakeLink, fault: str, protocol: Protocol
) -> None:
    SNAPSHOTS.check(
        f"{fault}, {protocol}",
        {
            f"{rates[0]} to {rates[1]}, {'reader' if reader_first else 'writer'} first": story(
                link(protocol, rates, reader_first), fault, *FAULTS[fault]
            )
            for rates, reader_first in ENDS
        },
    )
