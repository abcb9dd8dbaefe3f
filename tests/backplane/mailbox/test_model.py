"""The mailbox protocol is checked in every state of its model, and mutants of it are detected."""

from __future__ import annotations

from typing import Any

import pytest

from tests.backplane.mailbox.model import CLAIM, JUDGE, LOSE, PUBLISH, READ, Memory, Setup, explore

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
NOT_PUBLISHED = "a reader returns a message that was not published"
NOT_BAD = "a reader takes a published message for a bad one"
NO_CLAIM = "a message is published without the valid claim"
SC, WEAK = Memory.SC, Memory.WEAK
EARLY = (PUBLISH[0], PUBLISH[3], PUBLISH[2], PUBLISH[1], *PUBLISH[4:])
MUTANTS: dict[str, tuple[Memory, dict[str, Any], str]] = {
    "head before slot": (SC, {"publish": (PUBLISH[0], PUBLISH[-1], *PUBLISH[1:-2])}, NOT_BAD),
    "no checksum": (SC, {"is_checked": False}, NOT_PUBLISHED),
    "no epoch": (SC, {"is_claimed": False, "forgeries": 1}, NOT_PUBLISHED),
    "relaxed store of the head": (WEAK, {"publish": (*PUBLISH[:-2], PUBLISH[-1])}, NOT_BAD),
    "relaxed load of the head": (WEAK, {"read": (READ[0], *READ[2:])}, NOT_BAD),
    "no fence before a slot is filled": (WEAK, {"publish": PUBLISH[1:]}, NOT_BAD),
    "no fence before a copy is judged": (WEAK, {"judge": JUDGE[1:]}, NOT_BAD),
    "claim after publication": (
        SC,
        {"claim": CLAIM[1:], "publish": (*PUBLISH, CLAIM[0])},
        NO_CLAIM,
    ),
    "claim without the kernel's lock": (SC, {"is_locked": False}, NO_CLAIM),
    "slots of a dead writer left filled": (SC, {"claim": CLAIM[:1], "losses": 1}, NOT_PUBLISHED),
    "signature before message": (SC, {"publish": EARLY, "forgeries": 1}, NOT_PUBLISHED),
    "signature loaded after the message": (
        SC,
        {"read": (*READ[:2], *READ[:1:-1]), "forgeries": 1},
        NOT_PUBLISHED,
    ),
    "reader waits for a slot being filled": (SC, {"waits": True}, "a reader waits"),
}
"""Mistakes in the protocol, and what each violates."""


@pytest.mark.thorough
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("memory", Memory)
def test_the_protocol_holds_in_every_state(memory: Memory, case: str) -> None:
    exploration = explore(Setup(memory, **CASES[case]))
    assert (exploration.violation, exploration.steps) == ("", ())
    assert exploration.states > 5_000


@pytest.mark.slow
def test_on_x86_it_holds_without_fences() -> None:
    """Plain loads and stores are enough there: those of Python are such."""
    coded = {"publish": PUBLISH, "lose": LOSE, "read": READ, "judge": JUDGE}
    plain: dict[str, Any] = {
        name: tuple(access for access in accesses if access != "fence")
        for name, accesses in coded.items()
    }
    assert not explore(Setup(Memory.TSO, words=COARSE, **plain)).violation
    assert explore(Setup(WEAK, words=COARSE, **plain)).violation


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MUTANTS)
def test_a_mistake_in_the_protocol_is_found(mistake: str) -> None:
    memory, settings, violation = MUTANTS[mistake]
    exploration = explore(Setup(memory, **settings))
    assert exploration.violation == violation, exploration.steps
    assert exploration.steps
