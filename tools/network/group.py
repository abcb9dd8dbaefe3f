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
    """Prepare racks for working together over a network."""


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
    r"""Make a set of certificates for tests: an authority, and a pair for each name.

    Racks know each other by name: the common name of a certificate is the name of the rack, and
    what a rack may send and read depends on it. Give a rack that listens the addresses or host
    names that stand in the others' `connect`: they check them. One that only connects, or a person
    who uses `rack estop HOST/RACK`, needs none.

    In DIR it writes authority.pem and authority-key.pem, and NAME.pem and NAME-key.pem for each
    name. NAME's key seals all its messages, and nobody else can. In a folder that holds a set
    already, it adds names to it. It never overwrites.

    A config names the folder in [adapter.lan]: certificates = "DIR", relative to the config. Each
    machine needs only authority.pem and its own pair. Keys must be readable by their owner alone.

    It is a set for tests: one folder holds the keys of all. Where it matters, have your own
    authority sign certificates with the same names, from keys on the curve P-256 that never leave
    their machines.

    Exit status: 0 made, 2 nothing was made.

    \b
    Examples:
      rack lan certificates certs --for cell=10.0.0.1 --for cell-puma=10.0.0.2
      rack lan certificates certs --for operator --days 30
    """
    try:
        from rack.tools.network.certificates import make_credentials, named_addresses
    except ImportError:
        raise Failure(
            "certificates are made with 'cryptography', which is missing: install nasrem-rack[lan]"
        ) from None
    by_name = named_addresses(names)
    made = make_credentials(folder, by_name, days)
    answer = {
        "folder": str(folder),
        "made": list(made.files),
        "names": by_name,
        "expires": made.expires.isoformat(timespec="seconds"),
    }
    first = next(iter(by_name))
    lines = [
        f"made in {folder}: {', '.join(made.files)}",
        f"valid until {made.expires:%Y-%m-%d}",
        "A set for tests: whoever has this folder can pass for any of these racks.",
        (
            f"Each machine needs only authority.pem and its own pair, as in {first}.pem and"
            f" {first}-key.pem."
        ),
    ]
    print_answer(answer, lines, as_json)
