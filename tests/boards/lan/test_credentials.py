"""Credentials: each file that cannot be used is named, with the reason."""

from __future__ import annotations

import os
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import NameOID

from rack.boards.lan.credentials import Credentials
from rack.tools.network import certificates
from rack.tools.network.certificates import make_credentials

DAY = timedelta(days=1)
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
    found = Credentials(folder, rack).find_flaws(addresses)
    return [str(flaw).removeprefix(f"{folder}/") for flaw in found]


def test_every_missing_file_is_named(tmp_path: Path) -> None:
    why = "the file is missing; see rack lan certificates --help"
    assert flaws(tmp_path) == [
        f"{name}: {why}" for name in ("authority.pem", "cell.pem", "cell-key.pem")
    ]


def test_a_file_that_cannot_be_read_is_named(folder: Path) -> None:
    (folder / "cell.pem").unlink()
    (folder / "cell.pem").mkdir()
    (folder / "cell-key.pem").unlink()
    os.mkfifo(folder / "cell-key.pem", 0o600)
    assert flaws(folder) == [
        "cell.pem: cannot be read: not a regular file, but a directory",
        "cell-key.pem: cannot be read: not a regular file, but a FIFO",
    ]


def test_a_key_that_others_can_read_is_refused(folder: Path) -> None:
    (folder / "cell-key.pem").chmod(0o640)
    assert flaws(folder) == ["cell-key.pem: mode 0640 lets others read it; it must be 0600"]


def test_a_certificate_is_for_the_addresses_on_which_the_rack_listens(made: Path) -> None:
    (flaw,) = flaws(made, "cell", "10.0.0.1", "10.0.0.9")
    assert flaw == (
        "cell.pem: the certificate is not valid for address 10.0.0.9;"
        " valid addresses: 10.0.0.1, cell.local"
    )


@pytest.mark.parametrize(
    ("copied", "flaw"),
    [
        (
            ("puma.pem", "puma-key.pem"),
            "cell.pem: the certificate is for 'puma' instead of rack 'cell'",
        ),
        (("puma-key.pem",), "cell-key.pem: the key does not belong to cell.pem"),
        (("authority.pem",), "cell.pem: the certificate is not signed by authority.pem"),
    ],
)
def test_files_that_do_not_belong_together_are_refused(
    folder: Path, tmp_path: Path, copied: tuple[str, ...], flaw: str
) -> None:
    make_credentials(tmp_path / "other", NAMES, 2)
    for name in copied:
        source = tmp_path / "other" if name == "authority.pem" else folder
        shutil.copy(source / name, folder / name.replace("puma", "cell"))
    assert flaws(folder) == [flaw]


@pytest.mark.parametrize("name", ["authority.pem", "cell.pem", "cell-key.pem"])
@pytest.mark.parametrize(
    "content", [b"nothing", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"]
)
def test_files_that_are_not_pem_are_refused(folder: Path, name: str, content: bytes) -> None:
    (folder / name).write_bytes(content)
    kind = "private key" if "key" in name else "certificate"
    assert f"{name}: the file contains no {kind} in PEM form" in flaws(folder)


NONE = serialization.NoEncryption()
OTHER_KIND = "the key is of another kind; it must be on the curve P-256"


@pytest.mark.parametrize(
    ("key", "encryption", "why"),
    [
        (
            ec.generate_private_key(ec.SECP256R1()),
            serialization.BestAvailableEncryption(b"word"),
            "the key is encrypted; it must have no password",
        ),
        (ec.generate_private_key(ec.SECP384R1()), NONE, OTHER_KIND),
        (Ed25519PrivateKey.generate(), NONE, OTHER_KIND),
    ],
    ids=["password", "another curve", "another algorithm"],
)
def test_a_key_with_a_password_or_of_another_kind_is_refused(
    folder: Path,
    key: PrivateKeyTypes,
    encryption: serialization.KeySerializationEncryption,
    why: str,
) -> None:
    form = serialization.PrivateFormat.PKCS8
    written = key.private_bytes(serialization.Encoding.PEM, form, encryption)
    (folder / "cell-key.pem").write_bytes(written)
    assert flaws(folder) == [f"cell-key.pem: {why}"]


@pytest.mark.parametrize(
    ("begins", "ends", "why"),
    [
        (-2, -1, "cell.pem: the certificate expired on 20"),
        (1, 2, "cell.pem: the certificate is not valid before 20"),
    ],
)
def test_a_certificate_that_is_not_valid_now_is_refused(
    folder: Path, begins: int, ends: int, why: str
) -> None:
    now = datetime.now(UTC)
    signer = serialization.load_pem_private_key((folder / "authority-key.pem").read_bytes(), None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    key = Credentials(folder, "cell").key_pair.key
    dates = now + begins * DAY, now + ends * DAY
    new = builder("cell", key, certificates.AUTHORITY_NAME, dates).sign(signer, hashes.SHA256())
    (folder / "cell.pem").write_bytes(certificates.to_pem(new))
    (flaw,) = flaws(folder)
    assert flaw.startswith(why)


def builder(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    above: str,
    dates: tuple[datetime, datetime],
    length: int | None = None,
) -> x509.CertificateBuilder:
    """Return a certificate with as little as the tools of others write; `length`: of the path
    below it, None: it may sign nothing."""
    own, issuer = (x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, n)]) for n in (name, above))
    made = x509.CertificateBuilder(issuer, own, key.public_key(), x509.random_serial_number())
    made = made.not_valid_before(dates[0]).not_valid_after(dates[1])
    return made.add_extension(x509.BasicConstraints(length is not None, length), critical=True)


def step(
    name: str, issuer: tuple[str, ec.EllipticCurvePrivateKey] | None, length: int | None
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Return a certificate and its key, signed by an issuer or itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    above, signer = issuer or (name, key)
    now = datetime.now(UTC)
    made = builder(name, key, above, (now - DAY, now + DAY), length)
    return made.sign(signer, hashes.SHA256()), key


@pytest.mark.parametrize(
    ("below", "expected"),
    [(0, []), (None, ["cell.pem: the certificate is not signed by authority.pem"])],
)
def test_an_authority_may_sign_through_another_but_not_through_a_rack(
    tmp_path: Path, below: int | None, expected: list[str]
) -> None:
    root, root_key = step("root", None, 1)
    between, between_key = step("puma", ("root", root_key), below)
    own, own_key = step("cell", ("puma", between_key), None)
    files = {
        "authority.pem": certificates.to_pem(root),
        "cell.pem": certificates.to_pem(own) + certificates.to_pem(between),
        "cell-key.pem": certificates.key_to_pem(own_key),
    }
    certificates.write_credentials(tmp_path, files)
    assert flaws(tmp_path) == expected
    found = Credentials(tmp_path, "cell")
    assert (found.identify_sender(found.key_pair.chain) is None) == bool(expected)
