"""Mistakes in `[adapter.lan]` that concern security: one line each, before any process starts."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rack.boards.config import load, load_text
from rack.boards.config.rules.lan import list_network_notes
from rack.tools.network.certificates import make_credentials
from tests.boards.config.mistakes import find_mistake, list_mistakes
from tests.boards.lan.racks import rack_text

TLS = "tls/127.0.0.1:7447"
SHAPE = "it must be tcp/, tls/ or quic/ with an address or host name and a port from 1 to 65535"


def mistakes(
    folder: Path, listen: str = "", lan: str = "", connect: tuple[str, ...] = ()
) -> list[str]:
    """Return the mistakes of a rack with this endpoint and further lines of `[adapter.lan]`."""
    path = folder / "rack.toml"
    path.write_text(rack_text("cell", listen, connect, peers=["puma"], lan=lan, insecure=False))
    return [*map(str, list_mistakes(path))]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "certs"
    make_credentials(folder, {"cell": ["127.0.0.1", "::1"]}, 40)
    return folder


@pytest.fixture
def own(made: Path, tmp_path: Path) -> str:
    """The line that names the rack's certificates, which are beside its config."""
    shutil.copytree(made, tmp_path / "certs")
    return 'certificates = "certs"'


NEAR = (
    "every user of this machine could impersonate another rack; use unix/ and a name or"
    " certificates, which protect messages, or accept it with adapter.lan.insecure = true"
)
FAR = (
    "other machines can reach this endpoint without TLS; use tls/ or quic/ with certificates or a"
    " loopback address, or accept it with adapter.lan.insecure = true"
)


@pytest.mark.parametrize(
    ("endpoint", "why"),
    [
        ("tcp/127.9.9.9:65535", NEAR),
        ("tcp/[::1]:7447", NEAR),
        ("tcp/0.0.0.0:7447", FAR),
        ("tcp/localhost.cell:7447", FAR),
    ],
)
def test_tcp_is_refused_unless_accepted_explicitly_or_protected_on_loopback(
    tmp_path: Path, own: str, endpoint: str, why: str
) -> None:
    line = f'[0] = "{endpoint}": {why}'
    assert mistakes(tmp_path, endpoint) == [f"adapter.lan.listen{line}"]
    assert mistakes(tmp_path, connect=(endpoint,)) == [f"adapter.lan.connect{line}"]
    assert mistakes(tmp_path, endpoint, "insecure = true") == []
    assert len(mistakes(tmp_path, endpoint, own)) == (why == FAR)


@pytest.mark.parametrize(
    ("endpoint", "why"),
    [
        ("tcp/127.0.0.1:0", SHAPE),
        ("tcp/127.1:7447", f"'127.1' is not an address; {SHAPE}"),
        ("tcp/[1::2::3]:7447", f"'1::2::3' is not an address; {SHAPE}"),
    ],
)
def test_a_malformed_endpoint_is_one_line(tmp_path: Path, endpoint: str, why: str) -> None:
    """Which texts are none is tested in `tests.boards.lan.test_endpoint`."""
    (line,) = mistakes(tmp_path, connect=(endpoint,))
    assert line.startswith(f'adapter.lan.connect[0] = "{endpoint}": {why}')


def test_tls_needs_certificates(tmp_path: Path) -> None:
    why = "missing; TLS needs certificates: see rack lan certificates --help"
    assert mistakes(tmp_path, TLS) == [f"adapter.lan.certificates: {why}"]


def test_flaws_of_all_certificate_files_are_reported_with_other_mistakes(tmp_path: Path) -> None:
    (tmp_path / "certs").mkdir()
    plain = "tcp/127.0.0.1:7448"
    lines = mistakes(tmp_path, TLS, 'certificates = "certs"', connect=(plain,))
    why = "this endpoint has no TLS but others have it"
    assert lines[0].startswith(f'adapter.lan.connect[0] = "{plain}": {why}')
    files = ("authority.pem", "cell.pem", "cell-key.pem")
    why = f"the file is missing; see rack lan certificates --help; in {tmp_path}/certs"
    assert lines[1:] == [f"adapter.lan.certificates: {name}: {why}" for name in files]


def test_certificates_are_found_next_to_the_config_from_anywhere(
    tmp_path: Path, own: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir("/")
    assert mistakes(tmp_path, TLS, own) == []
    config = load(tmp_path / "rack.toml")
    assert load_text(config.to_toml_text()) == config
    monkeypatch.chdir(tmp_path)
    (line,) = mistakes(tmp_path, TLS.replace("127.0.0.1", "127.0.0.2"), own)
    assert "not valid for address 127.0.0.2; valid addresses: 127.0.0.1, ::1" in line


def test_exports_over_tls_need_named_peers(tmp_path: Path, own: str) -> None:
    path = tmp_path / "rack.toml"
    path.write_text(rack_text("cell", TLS, (), lan=own))
    assert "adapter.lan.peers: missing; with TLS only racks" in find_mistake(path)


def test_a_certificate_cannot_be_checked_for_an_address_of_ipv6(tmp_path: Path, own: str) -> None:
    assert mistakes(tmp_path, "tls/[::1]:7447", own) == []
    (line,) = mistakes(tmp_path, "", own, connect=("tls/[::1]:7447",))
    assert "use a host name or an IPv4 address" in line


def test_a_launch_warns_of_certificates_that_expire_soon(tmp_path: Path) -> None:
    for days, count in ((29, 1), (31, 0)):
        make_credentials(tmp_path / f"for{days}", {"cell": ["127.0.0.1"]}, days)
        assert mistakes(tmp_path, TLS, f'certificates = "for{days}"') == []
        notes = list_network_notes(load(tmp_path / "rack.toml"))
        assert [note.startswith("certificates expire on 20") for note in notes] == [True] * count


def test_a_launch_without_tls_reports_possible_attacks(tmp_path: Path, own: str) -> None:
    far, near = "tcp/10.0.0.1:7447", "tcp/127.0.0.1:7447"
    forge, read = "read and forge messages", "read messages, and pretend that racks come and go"
    for listen, lan, could in (
        (near, "insecure = true", forge),
        (near, own, read),
        ("unix/cell", "", ""),
        (TLS, own, ""),
        (far, "insecure = true", forge),
        (far, f"insecure = true\n{own}", read),
    ):
        assert mistakes(tmp_path, listen, lan) == []
        notes = [f"no TLS: whoever reaches {listen} can {could}"] if could else []
        assert [*list_network_notes(load(tmp_path / "rack.toml"))] == notes


def test_remote_stops_are_refused_where_others_can_impersonate(tmp_path: Path, own: str) -> None:
    lan = 'estop_from = ["operator"]\n'
    for at, more, could in (
        ("tcp/127.0.0.1:7447", own, "repeat an earlier request of one of these racks"),
        ("tcp/10.0.0.1:7447", "insecure = true", "impersonate any of these racks"),
    ):
        line = f'adapter.lan.estop_from = "operator": whoever reaches {at} could {could}; use tls/'
        for found in (
            mistakes(tmp_path, at, lan + more),
            mistakes(tmp_path, "", lan + more, (at,)),
        ):
            assert [text.startswith(line) for text in found] == [True]
    assert mistakes(tmp_path, TLS, lan + own) == []
    assert mistakes(tmp_path, "unix/cell", lan, connect=("unix/puma",)) == []
