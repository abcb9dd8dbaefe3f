"""A connection that another machine refuses, or that this one does: each reason in one line."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from rack.boards.lan.credentials import Credentials
from rack.boards.lan.questions import Code, DeskAnswer, What
from rack.tools.console.address import Asker, HostAddress
from rack.tools.console.answer import Failure
from rack.tools.network import questioner
from rack.tools.network.certificates import make_credentials
from rack.tools.network.questioner import FarLaunch, Questioner, _Question, check_reach

HERE = "127.0.0.1"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two sets of credentials that know nothing of each other, each for a rack `cell` and an
    operator."""
    found = [tmp_path_factory.mktemp("set") / name for name in ("ours", "theirs")]
    for folder in found:
        make_credentials(folder, {"cell": [HERE], "operator": []}, days=1)
    return found[0], found[1]


@contextmanager
def listening(credentials: Credentials | None) -> Iterator[HostAddress]:
    """Accept one connection and shake hands, as a rack does; without credentials, hang up."""
    with socket.create_server((HERE, 0)) as server:

        def accept() -> None:
            connection, _ = server.accept()
            with connection, suppress(ssl.SSLError, OSError):
                if credentials is not None:
                    context = ssl.create_default_context(
                        ssl.Purpose.CLIENT_AUTH, cafile=credentials.authority
                    )
                    context.load_cert_chain(credentials.certificate, credentials.key)
                    context.verify_mode = ssl.CERT_REQUIRED
                    context.wrap_socket(connection, server_side=True).close()

        thread = Thread(target=accept, daemon=True)
        thread.start()
        yield HostAddress(HERE, server.getsockname()[1])
        thread.join(10)
        assert not thread.is_alive()


def refusal(at: HostAddress, asker: Asker) -> str:
    with pytest.raises(Failure) as failure:
        check_reach(at, asker)
    return str(failure.value).removeprefix(f"{at}: ")


def test_those_of_one_set_reach_each_other(folders: tuple[Path, Path]) -> None:
    with listening(Credentials(folders[0], "cell")) as at:
        check_reach(at, Asker("operator", str(folders[0])))


def test_a_rack_of_another_set_is_refused(folders: tuple[Path, Path]) -> None:
    ours, theirs = folders
    with listening(Credentials(theirs, "cell")) as at:
        assert refusal(at, Asker("operator", str(ours))).startswith(
            "its certificate is refused here: "
        )


def test_a_rack_that_knows_another_authority_refuses(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    ours, theirs = folders
    # It shows a certificate that we trust, and trusts others than we are.
    rack = Credentials(ours, "cell")
    rack.authority = theirs / "authority.pem"
    with listening(rack) as at:
        assert refusal(at, Asker("operator", str(ours))).startswith("TLS refused: tlsv1 alert ")


def test_a_port_without_tls_is_told(folders: tuple[Path, Path]) -> None:
    with listening(None) as at:
        assert refusal(at, Asker("operator", str(folders[0]))).startswith("TLS refused: ")


def test_a_missing_certificate_is_named(folders: tuple[Path, Path]) -> None:
    with listening(None) as at:
        why = refusal(at, Asker("stranger", str(folders[0])))
    assert why == f"{folders[0] / 'stranger.pem'}: missing; see rack lan certificates --help"


def test_another_machine_is_not_asked_without_certificates(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket.socket, "getpeername", lambda self: ("192.0.2.7", 7447))
    with listening(None) as at:
        assert (
            refusal(at, Asker()) == "not this machine, so it needs certificates; see --certificates"
        )


class Line(Questioner):
    """A session in which each question gets the next of these answers; None: it comes back without
    one. The last is repeated."""

    def __init__(self, *answers: Code | None) -> None:
        self._at, self._asker = HostAddress(HERE, 7447), Asker()
        self._launches = {"cell": 1}
        self._answers = [*answers]

    def _question(
        self, asked: FarLaunch, what: What, payload: bytes, first: int | None = None
    ) -> Any:
        code = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        replies = [] if code is None else [DeskAnswer(code, 0, 0, 0)]
        return _Question(asked, what, payload, 1, 1, "", replies)

    def _opened(self, question: Any, reply: Any) -> Any:
        return reply

    def stop(self) -> list[DeskAnswer]:
        """Ask for an emergency stop."""
        return list(self.ask(FarLaunch("cell", 1), "stop", [b""]))


@pytest.mark.parametrize("before", [None, Code.BUSY])
def test_a_question_is_asked_on_while_the_way_to_the_rack_is_not_there_yet(
    before: Code | None,
) -> None:
    (answer,) = Line(*[before] * 15, Code.GRANTED).stop()
    assert answer.code is Code.GRANTED


def test_a_rack_that_never_takes_a_question_does_not_permit_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(questioner, "DENIED_S", 0.1)
    with pytest.raises(Failure, match="rack 'cell' does not permit"):
        Line(None).stop()
    # One that is busy does take it.
    monkeypatch.setattr(questioner, "PATIENCE_S", 0.3)
    with pytest.raises(Failure, match=r"has not answered for 0\.3 s"):
        Line(Code.BUSY).stop()
