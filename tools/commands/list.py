"""`rack list`: the racks on this machine, and on others."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from rack.tools.commands import answers
from rack.tools.console.address import OPERATOR, Asker, HostAddress, needing_zenoh
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.parameters import AskAs, Certificates, Json

Hosts = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[HOST[:PORT]]...", help="with --lan: where to look; default port: 7447"
    ),
]
Lan = Annotated[
    bool,
    typer.Option("--lan", help="list the racks at these hosts, and those that racks here know"),
]


def list_racks(
    hosts: Hosts = None,
    lan: Lan = False,
    certificates: Certificates = "",
    name: AskAs = OPERATOR,
    as_json: Json = False,
) -> None:
    """List the racks on this machine, running or left behind by a killed launcher; with --lan those
    at other hosts.

    The states are starting, running and stopped; dead, if the launcher is gone; and foreign, if the
    shared memory is of another version or user. `rack clean` removes dead racks.

    With --lan the hosts given are asked, and the endpoints in `listen` and `connect` of the racks
    on this machine. A rack is shown with its age, and where the racks are that it works with:
    there, lost, or awaited. It is closed if it does not permit NAME to watch.

    \b
    Examples:
      rack list
      rack list --json
      rack list --lan 192.168.1.5 192.168.1.6 --certificates ~/cell
    """
    if not lan:
        if hosts:
            raise Failure(f"HOST = {hosts[0]}: needs --lan, as in: rack list --lan {hosts[0]}", 2)
        answers.list_racks(as_json)
        return
    asker = Asker.of(name, certificates)
    given = [HostAddress.of(host) for host in hosts or ()]
    with needing_zenoh():
        from rack.tools.network.listing import known_hosts, racks_at
    from rack.tools.console.tables import fitted

    found = racks_at(list(dict.fromkeys([*given, *known_hosts()])), asker)
    rows = [[row.host, row.rack, row.state, row.detail] for row in found]
    nothing = "no hosts: no rack here has an adapter; to look elsewhere: rack list --lan HOST"
    shown = fitted(("host", "rack", "state", ""), rows) if rows else nothing
    print_answer([asdict(row) for row in found], shown, as_json)
