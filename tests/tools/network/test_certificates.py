"""`rack lan certificates` as a user runs it."""

from __future__ import annotations

import os
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from rack.boards.lan.credentials import Credentials
from tests.tools.command_line import rack, read_answer, read_refusal

SHARED = ["authority.pem", "authority-key.pem"]


def test_a_set_is_made_for_every_name_and_only_its_owner_may_read_it(tmp_path: Path) -> None:
    folder = tmp_path / "new/certs"
    words = ("--for", "cell=10.0.0.1,cell.local", "--for", "operator")
    done = rack("lan", "certificates", folder, *words)
    assert (done.returncode, done.stderr) == (0, "")
    names = [*SHARED, "cell.pem", "cell-key.pem", "operator.pem", "operator-key.pem"]
    assert sorted(path.name for path in folder.iterdir()) == sorted(names)
    assert list(Credentials(folder, "cell").find_flaws(["10.0.0.1", "cell.local"])) == []
    assert list(Credentials(folder, "operator").find_flaws()) == []
    assert "This set is for tests" in done.stdout
    assert "Each machine needs only authority.pem and one pair" in done.stdout
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == {0o600}


def test_a_set_is_valid_for_a_year_or_as_long_as_ordered(tmp_path: Path) -> None:
    for at, (days, options) in enumerate([(365, ()), (3, ("--days", 3))]):
        rack("lan", "certificates", tmp_path / str(at), "--for", "cell", *options)
        for name in ("cell.pem", "authority.pem"):
            found = x509.load_pem_x509_certificate((tmp_path / str(at) / name).read_bytes())
            left = found.not_valid_after_utc - datetime.now(UTC)
            assert abs(left - timedelta(days=days)) < timedelta(hours=1)


def test_names_are_added_by_the_same_authority(tmp_path: Path) -> None:
    rack("lan", "certificates", tmp_path, "--for", "cell", "--days", 2)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    answer = read_answer("lan", "certificates", tmp_path, "--for", "puma=10.0.0.2")
    assert answer["made"] == ["puma.pem", "puma-key.pem"]
    assert answer["names"] == {"puma": ["10.0.0.2"]}
    # Not longer than its authority.
    assert datetime.fromisoformat(answer["expires"]) < datetime.now(UTC) + timedelta(days=2)
    assert list(Credentials(tmp_path, "puma").find_flaws(["10.0.0.2"])) == []
    assert {path: path.read_bytes() for path in before} == before


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    rack("lan", "certificates", tmp_path, "--for", "cell")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    done = rack("lan", "certificates", tmp_path, "--for", "puma", "--for", "cell")
    why = "cell.pem, cell-key.pem exist already; nothing is overwritten"
    assert read_refusal(done) == f"{tmp_path}: {why}"
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", SHARED)
def test_an_incomplete_or_endless_set_is_not_extended(tmp_path: Path, name: str) -> None:
    rack("lan", "certificates", tmp_path, "--for", "cell")
    (tmp_path / name).unlink()
    lacking = "the file is missing; see rack lan certificates --help"
    for why in (lacking, "cannot be read: not a regular file, but a FIFO"):
        done = rack("lan", "certificates", tmp_path, "--for", "puma")
        assert read_refusal(done) == f"{tmp_path / name}: {why}"
        assert not (tmp_path / "puma.pem").exists()
        if why == lacking:
            os.mkfifo(tmp_path / name, 0o600)


def test_another_key_does_not_sign_for_the_authority(tmp_path: Path) -> None:
    for name in ("a", "b"):
        rack("lan", "certificates", tmp_path / name, "--for", "cell")
    (tmp_path / "a/authority-key.pem").write_bytes((tmp_path / "b/authority-key.pem").read_bytes())
    refusal = read_refusal(rack("lan", "certificates", tmp_path / "a", "--for", "puma"))
    assert "authority-key.pem is not the key of authority.pem" in refusal


BAD = {
    **dict.fromkeys(("Cell", "", "../cell"), "a name consists of"),
    **dict.fromkeys(("authority", "cell-key"), "a file of the set would have this name"),
    **dict.fromkeys(
        ("cell=", "cell=10.0.0.1,", "cell=300.0.0.1", "cell=*.local", "cell=10.0.0.1:7447"),
        "it must be NAME or NAME=ADDRESS",
    ),
}


@pytest.mark.parametrize(("given", "why"), BAD.items())
def test_an_invalid_name_or_address_is_reported_in_one_line(
    tmp_path: Path, given: str, why: str
) -> None:
    done = rack("lan", "certificates", tmp_path / "certs", "--for", given)
    assert read_refusal(done).startswith(f'--for = "{given}": {why}')
    assert not (tmp_path / "certs").exists()
