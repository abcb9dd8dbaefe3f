"""Hand-overs one after the other, each cut short at a store to shared memory, while others read."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping

import pytest

from tests.boards.run.hand_overs import CRIPPLES
from tests.conftest import EXHAUSTIVE
from tests.processes import BOUND_S, run_to_end

pytestmark = pytest.mark.thorough
ROUNDS = 110_000 if EXHAUSTIVE else 330
MUTANT_ROUNDS = 1500
LIMIT_S = 4 * 3600.0 if EXHAUSTIVE else 4 * BOUND_S
WRONG = ("torn", "missing", "double")
MAX_STALE = 1e-3
"""Largest fraction of rounds in which a reader may get the message of a replaced process. Two in
330,000 did, and it is not known why. Perhaps this test misjudges a message that was published."""


def hand_over(rack: str, rounds: int, cripple: str = "") -> Mapping[str, int]:
    """Return the counts of some rounds of hand-overs, one of whose safeguards is crippled."""
    command = [sys.executable, "-m", "tests.boards.run.hand_overs", rack, str(rounds)]
    done = run_to_end([*command, *filter(None, [cripple])], LIMIT_S)
    assert done.returncode == 0, done.stderr
    found: Mapping[str, int] = json.loads(done.stdout)
    return found


@pytest.mark.timeout(LIMIT_S)
def test_no_hand_over_tears_a_message_or_makes_two_writers(rack_name: str) -> None:
    found = hand_over(rack_name, ROUNDS)
    assert {name: found[name] for name in WRONG} == dict.fromkeys(WRONG, 0)
    assert found["stale"] <= max(1, MAX_STALE * ROUNDS)
    # Each store between claim and publication is the last one of some process.
    assert found["stores"] > 60
    assert found["rounds"] > 3 * found["stores"]
    assert found["hand_overs"] > 0.8 * ROUNDS
    assert min(found["killed"], found["stopped"]) > 0.3 * ROUNDS
    assert min(found["continued at once"], found["continued too late"]) > 0.1 * ROUNDS
    assert found["read"] > ROUNDS


@pytest.mark.parametrize("cripple", CRIPPLES)
def test_a_missing_safeguard_is_found(rack_name: str, cripple: str) -> None:
    wrong = CRIPPLES[cripple][-1]
    assert hand_over(rack_name, MUTANT_ROUNDS, cripple)[wrong] > 0
