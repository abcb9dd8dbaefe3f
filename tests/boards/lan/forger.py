"""A member of a network that speaks in the name of another: `python -m tests.boards.lan.forger
FOLDER NAME OTHER ENDPOINT...`.

It has a certificate of its own, NAME's in FOLDER, and those of another network in FOLDER/theirs. To
each message of OTHER's pulse it sends later ones in OTHER's name, with every seal that it can make,
and the message itself once more. To each line on stdin it answers with one of JSON: how many
messages it has heard, how many of them it could open, and how many it has forged. It ends with its
stdin.
"""

from __future__ import annotations

import sys
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

import zenoh
from cryptography.x509 import load_pem_x509_certificate

from rack.boards.lan.credentials import Credentials
from rack.boards.lan.envelope import Flaw, Sealer
from rack.boards.lan.keys import out_key
from rack.boards.lan.link import ReceivedMessage
from rack.tools.network import certificates
from tests.boards.lan.home import open_session, serve

PERIOD_S = 0.01
LATER = 1000
"""By how much a forged message is later than the one that it follows."""
FORGED = 1 << 40
"""Count in a forged message."""


def below(folder: Path, signer: str, name: str, made: Path) -> Credentials:
    """Return credentials in the name of another that the holder of a certificate has signed."""
    own = Credentials(folder, signer)
    issuer = load_pem_x509_certificate(own.certificate.read_bytes())
    now = datetime.now(UTC)
    key = certificates.ec.generate_private_key(certificates.ec.SECP256R1())
    authority = certificates.Authority(issuer, own.key_pair.key)
    found = certificates.sign_certificate(name, key, authority, now + timedelta(days=1))
    of_name = Credentials(made, name)
    chain = certificates.to_pem(found) + own.key_pair.chain
    files = {
        "authority.pem": own.authority.read_bytes(),
        of_name.certificate.name: chain,
        of_name.key.name: certificates.key_to_pem(key),
    }
    certificates.write_credentials(made, files)
    return of_name


class Forger:
    """A session without rules of its own."""

    def __init__(self, folder: Path, name: str, other: str, endpoints: list[str]) -> None:
        self._session = open_session({"connect/endpoints": endpoints})
        self._own = Sealer(Credentials(folder, name))
        self._sealers = [
            self._own,
            Sealer(Credentials(folder / "theirs", other)),
            Sealer(below(folder, name, other, folder / "below")),
            Sealer(),
        ]
        self._key = out_key(other, "pulse.status")
        self._count = Counter[str](heard=0, opened=0, forged=0)
        self._heard = self._session.declare_subscriber(self._key, zenoh.handlers.RingChannel(64))

    def cycle(self) -> None:
        """Forge what follows on each message that has come, then send it again."""
        while (sample := self._heard.try_recv()) is not None:
            key, envelope, payload = ReceivedMessage.from_sample(sample)
            head = self._own.open_message(key, envelope, payload)
            self._count["heard"] += 1
            if isinstance(head, Flaw):
                continue
            self._count["opened"] += 1
            later = head._replace(serial=head.serial + LATER, number=head.number + LATER)
            content = payload[:-8] + FORGED.to_bytes(8, "little")
            for sealer in self._sealers:
                self._put(sealer.seal(key, later, content), content)
                self._count["forged"] += 1
            self._put(envelope, payload)

    def _put(self, envelope: bytes | None, payload: bytes) -> None:
        self._session.put(
            self._key, payload, attachment=envelope, allowed_destination=zenoh.Locality.REMOTE
        )

    def state(self) -> dict[str, int]:
        return dict(self._count)


def main(folder: str, name: str, other: str, *endpoints: str) -> None:
    forger = Forger(Path(folder), name, other, list(endpoints))
    serve(forger.cycle, forger.state, PERIOD_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
