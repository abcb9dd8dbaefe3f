"""Envelopes: what was sealed comes out as it went in; whatever else comes from the network is
refused and counted."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import rack.boards.lan
from rack.boards.lan.envelope import HEAD_BYTES, Envelope, Flaw, Sealer

MOST = 256
KEY = "rack/cell/out/task/status"
HEAD = Envelope(1, 2, 3, 4, 5, 6, 7)
WORDS, SIGNED = st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1)
HEADS = st.builds(
    Envelope, WORDS, WORDS, WORDS, WORDS, SIGNED, SIGNED, SIGNED, st.integers(0, 2**32 - 1)
)
PAYLOADS = st.binary(max_size=MOST)
SEALER = Sealer(b"s" * 32, MOST)


@pytest.mark.slow
@given(st.text(), HEADS, PAYLOADS)
def test_what_was_sealed_is_opened_unchanged(key: str, head: Envelope, payload: bytes) -> None:
    assert SEALER.opened(key, SEALER.seal(key, head, payload), payload) == head


@given(st.text(), st.none() | st.binary(max_size=2 * HEAD_BYTES), st.binary(max_size=2 * MOST))
def test_arbitrary_input_raises_nothing_and_never_passes(
    key: str, envelope: bytes | None, payload: bytes
) -> None:
    assert isinstance(SEALER.opened(key, envelope, payload), Flaw)


@given(st.data(), PAYLOADS)
def test_no_bit_of_envelope_or_payload_can_change(data: st.DataObject, payload: bytes) -> None:
    envelope = SEALER.seal(KEY, HEAD, payload)
    whole = bytearray(envelope + payload)
    bit = data.draw(st.integers(0, 8 * len(whole) - 1))
    whole[bit // 8] ^= 1 << bit % 8
    assert isinstance(
        SEALER.opened(KEY, bytes(whole[:HEAD_BYTES]), bytes(whole[HEAD_BYTES:])), Flaw
    )


@given(st.data())
def test_a_message_with_another_end_is_no_message(data: st.DataObject) -> None:
    payload = b"content"
    whole = SEALER.seal(KEY, HEAD, payload) + payload
    cut = data.draw(st.integers(0, len(whole) - 1))
    assert isinstance(SEALER.opened(KEY, whole[:cut][:HEAD_BYTES], whole[:cut][HEAD_BYTES:]), Flaw)
    more = data.draw(st.binary(min_size=1, max_size=16))
    assert SEALER.opened(KEY, whole[:HEAD_BYTES], payload + more) is Flaw.UNSIGNED


@given(st.text(), st.text(), PAYLOADS)
def test_a_message_replayed_under_another_key_is_unsigned(
    key: str, other: str, payload: bytes
) -> None:
    assume(key != other)
    assert SEALER.opened(other, SEALER.seal(key, HEAD, payload), payload) is Flaw.UNSIGNED


@given(st.text(min_size=1), PAYLOADS)
def test_the_end_of_a_key_cannot_pass_for_the_beginning_of_a_payload(
    key: str, payload: bytes
) -> None:
    moved = key[-1].encode() + payload
    assume(len(moved) <= MOST)
    assert SEALER.opened(key[:-1], SEALER.seal(key, HEAD, payload), moved) is Flaw.UNSIGNED


@given(st.binary(max_size=64), PAYLOADS)
def test_a_seal_made_with_another_secret_does_not_fit(secret: bytes, payload: bytes) -> None:
    # BLAKE2b fills a key up with zeros.
    assume(secret.rstrip(b"\0") != b"s" * 32)
    assert SEALER.opened(KEY, Sealer(secret).seal(KEY, HEAD, payload), payload) is Flaw.UNSIGNED


def test_flaws_are_counted_by_cause() -> None:
    sealer, fits = Sealer(b"s" * 32, MOST), bytes(MOST)
    sealed = sealer.seal(KEY, HEAD, fits)
    for envelope, payload in (
        (sealed, fits),
        (sealed, bytes(MOST + 1)),
        (None, fits),
        (sealed[:-1], fits),
        (b"RLN0" + sealed[4:], fits),
        (sealed, fits[1:]),
    ):
        sealer.opened(KEY, envelope, payload)
    assert sealer.flaws == {Flaw.MALFORMED: 3, Flaw.UNSIGNED: 1, Flaw.OVERSIZED: 1}
    successor = Sealer(b"s" * 32, MOST)
    successor.resume(sealer.flaws.values())
    successor.opened(KEY, None, fits)
    assert successor.flaws == {Flaw.MALFORMED: 4, Flaw.UNSIGNED: 1, Flaw.OVERSIZED: 1}


def test_nothing_from_the_network_is_decoded_as_a_program() -> None:
    imported = set()
    for path in Path(rack.boards.lan.__path__[0]).glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            match node:
                case ast.Import(names):
                    imported |= {name.name for name in names}
                case ast.ImportFrom(str(module)):
                    imported.add(module)
                case ast.Name("eval" | "exec" as name):
                    imported.add(name)
    assert not imported & {"pickle", "marshal", "shelve", "eval", "exec"}
