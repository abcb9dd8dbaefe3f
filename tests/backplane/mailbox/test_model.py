"""The mailbox protocol is checked in every state of its model, and mutants of it are detected."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest

from tests.backplane.mailbox.model import (
    CLAIM,
    JUDGE,
    LOSE,
    PUBLISH,
    READ,
    TAKE_OVER,
    Memory,
    Setup,
    explore,
)
from tests.conftest import EXHAUSTIVE

COARSE = ("e", "s", "pc")
"""Words of a slot, where two readers copy them: content and checksum together."""
CASES: dict[str, dict[str, Any]] = {
    "one reader of all words, one kill": {},
    "two kills": {"kills": 2, "words": COARSE},
    "two reads": {"reads": 2, "words": COARSE},
    "two readers": {"readers": 2, "words": COARSE},
    "lost serials": {"messages": 4, "losses": 1, "words": COARSE},
    "forged messages": {"messages": 4, "forgeries": 1, "words": COARSE},
}
"""What may happen, by name, while five messages go through four slots."""
TAKE_OVERS: dict[str, dict[str, Any]] = {
    "a take-over": {"kills": 0},
    "a take-over and a kill": {"kills": 1},
    "two reads and a take-over": {"kills": 0, "reads": 2},
    "two take-overs": {"kills": 0, "stops": 2},
    "two take-overs and a kill": {"kills": 1, "stops": 2},
}
"""What may happen while stopped writers are replaced, and each still stores a message."""
MESSAGES = {Memory.SC: 3, Memory.TSO: 1, Memory.WEAK: 2}
LARGEST = (Memory.TSO, "two take-overs and a kill")
"""Has so many states that it is tried under `EXHAUSTIVE` only. Its parts are always tried."""
STOPPED: dict[str, Any] = {"kills": 0, "stops": 1, "words": COARSE, "claim": TAKE_OVER}
WEAK = {"memory": Memory.WEAK}
NOT_PUBLISHED = "a reader returns a message that was not published"
NOT_BAD = "a reader takes a published message for a bad one"
TWO_OF_ONE_SERIAL = "two messages of one serial are published"
NO_CLAIM = "a message is published without the valid claim"
MUTANTS: dict[str, tuple[dict[str, Any], str]] = {
    "head before slot": ({"publish": (*PUBLISH[:1], PUBLISH[-1], *PUBLISH[1:-2])}, NOT_BAD),
    "no checksum": ({"is_checked": False}, NOT_PUBLISHED),
    "no epoch": ({"is_claimed": False, "forgeries": 1}, NOT_PUBLISHED),
    "relaxed store of the head": ({**WEAK, "publish": (*PUBLISH[:-2], PUBLISH[-1])}, NOT_BAD),
    "relaxed load of the head": ({**WEAK, "read": (READ[0], *READ[2:])}, NOT_BAD),
    "no fence before a slot is filled": ({**WEAK, "publish": PUBLISH[1:]}, NOT_BAD),
    "no fence before a copy is judged": ({**WEAK, "judge": JUDGE[1:]}, NOT_BAD),
    "claim after publication": (
        {"claim": (*CLAIM[:2], CLAIM[3]), "publish": (*PUBLISH, CLAIM[2])},
        NO_CLAIM,
    ),
    "claim without the kernel's lock": ({"is_locked": False}, NO_CLAIM),
    "slots of a dead writer left filled": (
        # Bounds of serials protect from this too.
        {"claim": CLAIM[:3], "losses": 1, "is_bounded": False},
        NOT_PUBLISHED,
    ),
    "signature before message": (
        {
            "publish": (PUBLISH[0], PUBLISH[3], PUBLISH[2], PUBLISH[1], *PUBLISH[4:]),
            "forgeries": 1,
        },
        NOT_PUBLISHED,
    ),
    "signature loaded after the message": (
        {"read": (*READ[:2], *READ[:1:-1]), "forgeries": 1},
        NOT_PUBLISHED,
    ),
    "message of a stopped writer accepted": ({**STOPPED, "is_bounded": False}, NOT_PUBLISHED),
    "checksum without the epoch": ({**STOPPED, "is_bound": False}, NOT_PUBLISHED),
    "claim not loaded for a known writer": ({**STOPPED, "is_claim_loaded": False}, NOT_PUBLISHED),
    "head not loaded again after the claim": ({**STOPPED, "claim": CLAIM}, TWO_OF_ONE_SERIAL),
    "relaxed load of the claim": (
        {**WEAK, **STOPPED, "stops": 2, "messages": 1, "read": (*READ[:5], READ[6])},
        NOT_PUBLISHED,
    ),
    "claim before its bound": ({"claim": (CLAIM[2], *CLAIM[1:2], CLAIM[0], CLAIM[3])}, NOT_BAD),
    "reader waits for a slot being filled": ({"waits": True}, "a reader waits"),
}
"""Mistakes in the protocol, and what each violates."""


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("memory", Memory)
def test_the_protocol_holds_in_every_state(memory: Memory, case: str) -> None:
    exploration = explore(Setup(memory=memory, **CASES[case]))
    assert (exploration.violation, exploration.steps) == ("", ())
    assert exploration.states > 5_000


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("memory", "case"),
    [pair for pair in product(Memory, TAKE_OVERS) if EXHAUSTIVE or pair != LARGEST],
)
def test_the_protocol_holds_in_every_state_of_a_take_over(memory: Memory, case: str) -> None:
    settings = {"stops": 1, **TAKE_OVERS[case]}
    # Two stopped writers have many more states.
    messages = MESSAGES[memory] if settings["stops"] == 1 else 1
    settings |= {"messages": messages, "words": COARSE, "claim": TAKE_OVER}
    exploration = explore(Setup(memory=memory, **settings))
    assert (exploration.violation, exploration.steps) == ("", ())
    assert exploration.states > 1_000


@pytest.mark.thorough
def test_on_x86_it_holds_without_fences() -> None:
    """Plain loads and stores are enough there: those of Python are such."""
    fenced = {"publish": PUBLISH, "lose": LOSE, "read": READ, "judge": JUDGE}
    plain: dict[str, Any] = {
        name: tuple(access for access in accesses if access != "fence")
        for name, accesses in fenced.items()
    }
    assert not explore(Setup(memory=Memory.TSO, words=COARSE, **plain)).violation
    assert explore(Setup(memory=Memory.WEAK, words=COARSE, **plain)).violation


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MUTANTS)
def test_a_mistake_in_the_protocol_is_found(mistake: str) -> None:
    settings, violation = MUTANTS[mistake]
    exploration = explore(Setup(**settings))
    assert exploration.violation == violation, exploration.steps
    assert exploration.steps
