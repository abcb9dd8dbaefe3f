"""Credentials: each file that cannot be used is named, with the reason."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from rack.boards.lan.credentials import Credentials
from rack.tools.network.certificates import make_credentials

NAMES = {"cell": ["10.0.0.1", "cell.local"], "puma": []}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set that is never changed."""
    folder = tmp_path_factory.mktemp("made") / "set"
    make_credentials(folder, NAMES, 2)
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """A set to spoil."""
    return Path(shutil.copytree(made, tmp_path / "set"))


def flaws(folder: Path, rack: str = "cell", *addresses: str) -> list[str]:
    """Return what is wrong, without the folder's name."""
    return [
        str(flaw).removeprefix(f"{folder}/") for flaw in Credentials(folder, rack).flaws(addresses)
    ]


def test_a_set_as_made_has_no_flaws(made: Path) -> None:
    assert flaws(made, "cell", "10.0.0.1", "cell.local") == flaws(made, "puma") == []
    assert len(Credentials(made, "cell").secret) == 32


def test_every_missing_file_is_named(tmp_path: Path) -> None:
    why = "missing; see rack lan certificates --help"
    assert flaws(tmp_path) == [
        f"{name}: {why}" for name in ("authority.pem", "cell.pem", "cell-key.pem", "secret")
    ]


def test_a_file_that_cannot_be_read_is_named(folder: Path) -> None:
    (folder / "cell.pem").unlink()
    (folder / "cell.pem").mkdir()
    assert flaws(folder) == ["cell.pem: cannot be read: Is a directory"]


@pytest.mark.parametrize("name", ["cell-key.pem", "secret"])
@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_what_others_may_read_is_refused(folder: Path, name: str, mode: int) -> None:
    (folder / name).chmod(mode)
    assert flaws(folder) == [f"{name}: others may read it, mode {mode:04o}; permitted: 0600"]


def test_a_certificate_is_for_one_rack(folder: Path) -> None:
    shutil.copy(folder / "puma.pem", folder / "cell.pem")
    shutil.copy(folder / "puma-key.pem", folder / "cell-key.pem")
    assert flaws(folder) == ["cell.pem: for 'puma', not for rack 'cell'"]


def test_a_certificate_is_for_the_addresses_on_which_the_rack_listens(made: Path) -> None:
    (flaw,) = flaws(made, "cell", "10.0.0.1", "10.0.0.9")
    assert flaw == "cell.pem: not for address 10.0.0.9; for 10.0.0.1, cell.local"


def test_the_key_must_be_that_of_the_certificate(folder: Path) -> None:
    shutil.copy(folder / "puma-key.pem", folder / "cell-key.pem")
    assert flaws(folder) == ["cell-key.pem: not the key of cell.pem"]


def test_a_key_with_a_password_is_refused(folder: Path) -> None:
    path = folder / "cell-key.pem"
    key = serialization.load_pem_private_key(path.read_bytes(), None)
    locked = serialization.BestAvailableEncryption(b"word")
    form = serialization.PrivateFormat.PKCS8
    path.write_bytes(key.private_bytes(serialization.Encoding.PEM, form, locked))
    assert flaws(folder) == ["cell-key.pem: encrypted; permitted: a key without a password"]


def test_another_authority_has_not_signed_it(folder: Path, tmp_path: Path) -> None:
    make_credentials(tmp_path / "other", NAMES, 2)
    shutil.copy(tmp_path / "other/authority.pem", folder / "authority.pem")
    assert flaws(folder) == ["cell.pem: not signed by authority.pem"]


@pytest.mark.parametrize("name", ["authority.pem", "cell.pem", "cell-key.pem"])
@pytest.mark.parametrize(
    "content", [b"", b"nothing", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"]
)
def test_what_is_not_pem_is_refused(folder: Path, name: str, content: bytes) -> None:
    (folder / name).write_bytes(content)
    kind = "private key" if "key" in name else "certificate"
    assert f"{name}: no {kind} in PEM form" in flaws(folder)


@pytest.mark.parametrize(
    "content", [b"", b"short", bytes(31), bytes(33), b"ab" * 31, b"xy" * 32, b"\xff" * 64]
)
def test_a_secret_has_32_bytes(folder: Path, content: bytes) -> None:
    (folder / "secret").write_bytes(content)
    assert flaws(folder) == ["secret: no secret; permitted: 32 bytes, or 64 digits"]


def test_a_secret_may_be_hexadecimal(folder: Path) -> None:
    secret = Credentials(folder, "cell").secret
    (folder / "secret").write_text(secret.hex() + "\n")
    assert flaws(folder) == []
    assert Credentials(folder, "cell").secret == secret


def signed(folder: Path, begins: timedelta, ends: timedelta, chain: bool = False) -> Iterator[str]:
    """Put a certificate with other dates, or of an authority below the set's, in place of the
    rack's."""
    old = x509.load_pem_x509_certificate((folder / "cell.pem").read_bytes())
    issuer = x509.load_pem_x509_certificate((folder / "authority.pem").read_bytes())
    key = serialization.load_pem_private_key((folder / "authority-key.pem").read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    now, below = datetime.now(UTC), []
    if chain:
        own = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "below")])
        builder = (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(issuer.subject)
            .public_key(own.public_key())
        )
        dated = (
            builder.serial_number(1).not_valid_before(now).not_valid_after(now + timedelta(days=1))
        )
        issuer, key = dated.sign(key, hashes.SHA256()), own
        below = [issuer]
    builder = x509.CertificateBuilder().subject_name(old.subject).issuer_name(issuer.subject)
    builder = builder.public_key(old.public_key()).serial_number(2)
    new = (
        builder.not_valid_before(now + begins)
        .not_valid_after(now + ends)
        .sign(key, hashes.SHA256())
    )
    pem = b"".join(one.public_bytes(serialization.Encoding.PEM) for one in (new, *below))
    (folder / "cell.pem").write_bytes(pem)
    yield from flaws(folder)


def test_an_expired_certificate_is_refused(folder: Path) -> None:
    (flaw,) = signed(folder, timedelta(days=-2), timedelta(days=-1))
    assert flaw.startswith("cell.pem: expired on 20")


def test_a_certificate_not_valid_yet_is_refused(folder: Path) -> None:
    (flaw,) = signed(folder, timedelta(days=1), timedelta(days=2))
    assert flaw.startswith("cell.pem: not valid before 20")


def test_an_authority_may_sign_through_another(folder: Path) -> None:
    assert list(signed(folder, timedelta(), timedelta(days=1), chain=True)) == []
