"""A step on the network: what is packed is what comes, and nothing else is a step."""

from __future__ import annotations

import pytest

from rack.boards.lan.envelope import Envelope
from rack.boards.lan.link import Arrived
from rack.boards.lan.lockstep import STEP_KIND, Step, StepFlag, pack_step, unpack_step

HEAD = Envelope(STEP_KIND, 11, 1, 1, 40, 100_000_000, 0, StepFlag.OVER)
EXPORTS = (
    Arrived("a/first", b"head of one", b"payload"),
    Arrived("b", b"", b""),
    Arrived("c/third", b"h", b"x" * 300),
)


@pytest.mark.parametrize("count", range(4))
def test_a_step_arrives_as_it_was_sent(count: int) -> None:
    content = pack_step(5_000_000, ("puma", "k1607"), EXPORTS[:count])
    expected = Step(11, 100_000_000, StepFlag.OVER, 5_000_000, ("puma", "k1607"), EXPORTS[:count])
    assert unpack_step(HEAD, content) == expected


def test_an_export_without_an_envelope_arrives_with_an_empty_one() -> None:
    step = unpack_step(HEAD, pack_step(1, ("puma",), [Arrived("a", None, b"payload")]))
    assert step is not None
    assert step.exports == (Arrived("a", b"", b"payload"),)


def test_what_is_cut_off_continued_or_of_another_kind_is_no_step() -> None:
    content = pack_step(5_000_000, ("puma",), EXPORTS)
    assert [
        length for length in range(len(content)) if unpack_step(HEAD, content[:length]) is not None
    ] == []
    assert unpack_step(HEAD, content + b"x") is None
    assert unpack_step(HEAD._replace(kind=STEP_KIND + 1), content) is None
    # No text: a key of bytes that are no UTF-8.
    assert unpack_step(HEAD, content.replace(b"a/first", b"\xff/first")) is None
