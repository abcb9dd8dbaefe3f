"""Envelopes: what was sealed comes out as it went in; whatever else comes from the network is
refused and counted."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

import rack.boards.lan
from rack.boards.lan import credentials as files
from rack.boards.lan import keys
from rack.boards.lan.credentials import Credentials, KeyPair
from rack.boards.lan.envelope import (
    _HEAD,
    MAX_ENVELOPE_BYTES,
    MAX_MESSAGE_BYTES,
    Envelope,
    Flaw,
    Sealer,
)
from rack.tools.network.certificates import make_credentials
from tests.boards.lan.forger import below

MOST = 256
KEY = "rack/cell/out/task/status"
HEAD = Envelope(1, 2, 3, 4, 5, 6, 7)
WORDS, SIGNED = st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1)
HEADS = st.builds(
    Envelope, WORDS, WORDS, WORDS, WORDS, SIGNED, SIGNED, SIGNED, st.integers(0, 2**32 - 1), SIGNED
)
PAYLOADS = st.binary(max_size=MOST)
PLACES = st.integers(0, 1 << 20)
"""Of which those within an envelope count: the length of a signature varies."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The credentials of `cell` and `puma`; in `theirs` those of another network."""
    folder = tmp_path_factory.mktemp("certs")
    for each in (folder, folder / "theirs"):
        make_credentials(each, {"cell": [], "puma": []}, 1)
    return folder


@pytest.fixture(scope="module", params=["signed", "bare"])
def sealer(folder: Path, request: pytest.FixtureRequest) -> Sealer:
    """A sealer with the credentials of `cell`, and one without any."""
    return Sealer(Credentials(folder, "cell") if request.param == "signed" else None)


@pytest.mark.slow
@given(st.text(), HEADS, PAYLOADS)
def test_a_sealed_message_is_opened_unchanged(
    sealer: Sealer, end: str, head: Envelope, payload: bytes
) -> None:
    key = KEY + end
    assert sealer.open_message(key, sealer.seal(key, head, payload), payload) == head


@given(
    st.text(),
    st.none() | st.binary(max_size=2 * _HEAD.size),
    st.sampled_from([b"", b"RLN3"]),
    st.binary(max_size=2 * MOST),
)
def test_arbitrary_input_raises_nothing_and_never_passes(
    sealer: Sealer, key: str, envelope: bytes | None, magic: bytes, payload: bytes
) -> None:
    given = None if envelope is None else magic + envelope
    assert isinstance(sealer.open_message(key, given, payload), Flaw)


@given(PLACES, PAYLOADS)
def test_no_bit_of_envelope_or_payload_can_change(
    sealer: Sealer, place: int, payload: bytes
) -> None:
    envelope = sealer.seal(KEY, HEAD, payload)
    whole = bytearray(envelope + payload)
    bit = place % (8 * len(whole))
    whole[bit // 8] ^= 1 << bit % 8
    at = len(envelope)
    assert isinstance(sealer.open_message(KEY, bytes(whole[:at]), bytes(whole[at:])), Flaw)


@given(PLACES, st.binary(min_size=1, max_size=16))
def test_a_message_with_another_end_is_no_message(sealer: Sealer, place: int, more: bytes) -> None:
    payload = b"content"
    envelope = sealer.seal(KEY, HEAD, payload)
    whole = envelope + payload
    cut = place % len(whole)
    at = len(envelope)
    assert isinstance(sealer.open_message(KEY, whole[:cut][:at], whole[:cut][at:]), Flaw)
    assert sealer.open_message(KEY, envelope, payload + more) is Flaw.UNSIGNED
    assert isinstance(sealer.open_message(KEY, envelope + more, payload), Flaw)


@given(st.text(min_size=1), st.text(), PAYLOADS)
def test_a_message_replayed_under_another_key_is_unsigned(
    sealer: Sealer, end: str, other: str, payload: bytes
) -> None:
    assume(end != other)
    envelope = sealer.seal(KEY + end, HEAD, payload)
    assert sealer.open_message(KEY + other, envelope, payload) is Flaw.UNSIGNED
    # The end of a key cannot pass for the beginning of a payload.
    moved = end[-1].encode() + payload
    assert sealer.open_message((KEY + end)[:-1], envelope, moved) is Flaw.UNSIGNED


@pytest.mark.slow
def test_a_spoilt_certificate_names_nobody_else(folder: Path) -> None:
    own = Credentials(folder, "cell")
    chain = own.key_pair.chain
    for at in range(len(chain)):
        for change in (1, 0x80):
            spoilt = bytes([*chain[:at], chain[at] ^ change, *chain[at + 1 :]])
            identity = own.identify_sender(spoilt)
            # The authority has not signed how it says that it has signed: that may differ.
            assert identity is None or identity.key == own.key_pair.key.public_key()
    assert own.identify_sender(chain) is not None
    assert own.identify_sender(b"") is None
    assert own.identify_sender(chain + chain[:-1]) is None


def test_each_key_is_sealed_by_the_sender_that_it_names() -> None:
    assert keys.parse_sender(keys.estop_key("operator", "cell")) == "operator"
    answer = keys.estop_answer_key("cell", "operator")
    for key in (
        KEY,
        keys.out_key("cell", "ask.a"),
        keys.step_key("cell"),
        keys.ping_key("cell", "puma"),
        answer,
    ):
        assert keys.parse_sender(key) == "cell"
    for key in ("", "rack", "rack/", "rack//out/a", "other/cell/x"):
        assert keys.parse_sender(key) == ""


def forged(folder: Path, sealer: Sealer, mixed: KeyPair) -> Iterator[bytes]:
    """Yield envelopes for a message of `cell` that others have made who know all that `puma` has,
    and all that `cell` has sent."""
    puma = Sealer(Credentials(folder, "puma"))
    yield puma.seal(KEY, HEAD, b"")
    yield Sealer(Credentials(folder / "theirs", "cell")).seal(KEY, HEAD, b"")
    yield Sealer().seal(KEY, HEAD, b"")
    yield Sealer(below(folder, "puma", "cell", folder / "below")).seal(KEY, HEAD, b"")
    puma._pair = mixed
    yield puma.seal(KEY, HEAD, b"")
    yield sealer.seal(KEY, HEAD, b"").replace(b"cell", b"puma")


def test_no_rack_makes_the_seal_of_another(folder: Path) -> None:
    cell = Credentials(folder, "cell")
    sealer = Sealer(cell)
    mixed = KeyPair(cell.key_pair.chain, Credentials(folder, "puma").key_pair.key)
    found = [sealer.open_message(KEY, envelope, b"") for envelope in forged(folder, sealer, mixed)]
    assert found == [Flaw.UNSIGNED] * 6
    assert sealer.open_message(KEY, sealer.seal(KEY, HEAD, b""), b"") == HEAD


def test_a_seal_with_an_invalid_certificate_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sealer = Sealer(Credentials(folder, "cell"))
    envelope = sealer.seal(KEY, HEAD, b"")
    assert sealer.open_message(KEY, envelope, b"") == HEAD
    after_its_end = datetime.now(UTC) + timedelta(days=2)
    monkeypatch.setattr(files, "datetime", Mock(now=lambda zone: after_its_end))
    assert sealer.open_message(KEY, envelope, b"") is Flaw.UNSIGNED


def test_certificates_of_others_are_remembered_up_to_a_bound(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "MAX_REMEMBERED", 2)
    own = Credentials(folder, "cell")
    make_credentials(folder / "more", {f"rack-{at}": [] for at in range(5)}, 1)
    own.authority = folder / "more/authority.pem"
    for at in range(5):
        other = Credentials(folder / "more", f"rack-{at}")
        identity = own.identify_sender(other.key_pair.chain)
        assert identity is not None
        assert identity.name == f"rack-{at}"
        assert 0 < len(own._known) <= 2


def test_flaws_are_counted_by_cause(sealer: Sealer) -> None:
    fits = bytes(MAX_MESSAGE_BYTES)
    sealer.flaws = dict.fromkeys(Flaw, 0)
    sealed = sealer.seal(KEY, HEAD, fits)
    for envelope, payload in (
        (sealed, fits),
        (sealed, bytes(MAX_MESSAGE_BYTES + 1)),
        (None, fits),
        (sealed[: _HEAD.size], fits),
        (sealed + bytes(MAX_ENVELOPE_BYTES), fits),
        (b"RLN1" + sealed[4:], fits),
        (sealed, fits[1:]),
    ):
        sealer.open_message(KEY, envelope, payload)
    assert sealer.flaws == {Flaw.MALFORMED: 4, Flaw.UNSIGNED: 1, Flaw.OVERSIZED: 1}


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
