"""`rack lan`: preparation of racks for a network."""

from __future__ import annotations

from pathlib import Path

import typer

from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import Json, argument, option

app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None)
YEAR = 365


@app.callback()
def lan() -> None:
    """Make certificates for racks that work together over a network."""


@app.command()
def certificates(
    folder: Path = argument("DIR", "folder of the set; made if it does not exist"),
    names: list[str] = option(
        "--for NAME[=ADDRESS,...]",
        "rack, or person, that gets a certificate, with the addresses at which others"
        " reach it; repeatable",
        ...,
    ),
    days: int = option("--days N", "validity, days", YEAR, min=1, max=3650),
    as_json: Json = False,
) -> None:
    """Make a set of certificates for tests: an authority, and a pair for each name.

    The common name of a certificate is the name of the rack. It determines what the rack may send
    and read. For a rack that listens, give the addresses or host names that other racks use in
    `connect`, because they check them. A rack that only connects, or a person who uses
    `rack estop HOST/RACK`, needs none.

    The command writes authority.pem and authority-key.pem into DIR, and NAME.pem and NAME-key.pem
    for each name. The key of NAME seals all messages of NAME. If DIR already contains a set, the
    names are added to it. No file is overwritten.

    A config names the folder in [adapter.lan]: certificates = "DIR", relative to the config. Each
    machine needs only authority.pem and its own pair. Keys must be readable by their owner alone.

    The set is for tests, because one folder contains the keys of all racks. If security matters,
    let your own authority sign certificates with the same names, for keys on the curve P-256 that
    never leave their machines.

    Exit status: 0 if the set was made, 2 if nothing was made.

    \b
    Examples:
      rack lan certificates certs --for cell=10.0.0.1 --for cell-puma=10.0.0.2
      rack lan certificates certs --for operator --days 30
    """
    try:
        from rack.tools.network.certificates import make_credentials, parse_named_addresses
    except ImportError:
        raise Failure(
            "certificates are made with 'cryptography', which is missing: install nasrem-rack[lan]"
        ) from None
    by_name = parse_named_addresses(names)
    credentials = make_credentials(folder, by_name, days)
    answer = {
        "folder": str(folder),
        "made": list(credentials.files),
        "names": by_name,
        "expires": credentials.expires.isoformat(timespec="seconds"),
    }
    first = next(iter(by_name))
    lines = [
        f"made in {folder}: {', '.join(credentials.files)}",
        f"valid until {credentials.expires:%Y-%m-%d}",
        "This set is for tests: whoever has the folder can act as any of these racks.",
        f"Each machine needs only authority.pem and one pair: {first}.pem and {first}-key.pem.",
    ]
    print_answer(answer, lines, as_json)
