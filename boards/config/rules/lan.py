"""`[adapter.lan]`: what is exchanged with other racks, and how safely; where mistakes of its board
are shown.

The table makes a board, `lan`, which is checked like any other. A user knows it as `adapter.lan`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path

from rack.backplane.clock.system_clock import ticks_of
from rack.backplane.errors import ClockError
from rack.boards.config.connections import Wiring, is_taken
from rack.boards.config.mistakes import repeats
from rack.boards.config.schema import LAN, LanConfig, RackConfig
from rack.boards.errors import Mistake, Mistakes
from rack.boards.host.adapter import STATUS
from rack.boards.lan.config import FASTEST_HZ, ExportConfig, ImportConfig, LanTable
from rack.boards.lan.endpoint import Endpoint, endpoints_of, has_tls
from rack.levels.peer import peer_port

PLACE = "adapter.lan"
ITSELF = f"board.{LAN}"
INSTALL = "an exchange with other racks needs eclipse-zenoh: pip install 'nasrem-rack[lan]'"
SLOWER = "over a network goes what the task and elemental-move levels exchange"
_OWN = re.compile(rf"\bboard\.{LAN}(\.params)?(?=[.\[]|\b)")
_MAILBOX = f"mailbox {LAN}."


def network(wiring: Wiring, table: LanConfig) -> Mistakes:
    """Check the table, and what it names."""
    yield from _endpoints(table)
    if is_taken(wiring.config):
        why = f"[{PLACE}] makes the board of this name; rename the board, or leave one out"
        yield Mistake(ITSELF, None, why)
    else:
        yield from _board(wiring, table)
    for port, export in table.exports.items():
        for why in _export(wiring, export.source):
            yield Mistake(f"{PLACE}.export.{port}.from", export.source, why)
    for port, entry in table.imports.items():
        try:
            entry.message_class()
        except LookupError as error:
            yield Mistake(f"{PLACE}.import.{port}.type", entry.type, str(error))


def _board(wiring: Wiring, table: LanConfig) -> Mistakes:
    """Check the rates, the priority and the names of the adapter's board."""
    config = wiring.config
    yield from _names(table, config.name)
    if LAN in wiring.every:
        cycle_ns = wiring.every[LAN] * config.clock_ns
        for key, entries in (("export", table.exports), ("import", table.imports)):
            for port, entry in entries.items():
                yield from _rate(f"{PLACE}.{key}.{port}", entry, cycle_ns)
    if not config.is_lockstep:
        yield from _priority(config, table)
        if config.protocol.strict:
            why = (
                "what other racks send makes a run depend on timing, refused by protocol.strict ="
                " true"
            )
            yield Mistake(PLACE, None, f'{why}; permitted: clock.mode = "lockstep"')


def _names(table: LanTable, rack: str) -> Mistakes:
    """Check names of racks and ports: none twice, none of this rack, none that the adapter itself
    needs.
    """
    taken = {
        STATUS: "its status",
        **{peer_port(other): f"what it knows of rack '{other}'" for other in table.racks},
    }
    for port, entry in table.imports.items():
        place = f"{PLACE}.import.{port}"
        if port in taken:
            yield Mistake(
                place, None, f"the adapter writes {taken[port]} under this name; rename the port"
            )
        if entry.rack == rack:
            yield Mistake(
                f"{place}.from",
                entry.source,
                "a mailbox of this rack itself: levels here read it directly",
            )
    for key, entries in (("export", table.exports), ("import", table.imports)):
        for source, count in repeats(entry.source for entry in entries.values()):
            ports = ", ".join(port for port, entry in entries.items() if entry.source == source)
            yield Mistake(
                f"{PLACE}.{key}",
                source,
                f"listed {count} times: {ports}; any number of levels may read",
            )
    if rack in table.peers:
        yield Mistake(f"{PLACE}.peers", rack, "the name of this rack itself")
    for port, _ in repeats(map(peer_port, table.racks)):
        alike = [other for other in table.racks if peer_port(other) == port]
        why = (
            f"these names differ in '-' and '_' alone, so their mailboxes {LAN}.{port} are one;"
            " rename a rack"
        )
        yield Mistake(f"{PLACE}.peers", alike, why)


def _rate(place: str, entry: ExportConfig | ImportConfig, cycle_ns: int) -> Mistakes:
    of = ("of the adapter", "cycle")
    try:
        every = ticks_of(entry.rate_hz, cycle_ns, "exchange", of, FASTEST_HZ)
    except ClockError as error:
        yield Mistake(f"{place}.rate_hz", entry.rate_hz, str(error))
        return
    if isinstance(entry, ImportConfig):
        least_ms = (every + 1) * cycle_ns * 1e-6
        if entry.max_age_ms < least_ms:
            why = (
                "between two exchanges it gets as old as one of them and a cycle of the adapter,"
                f" {least_ms:.12g} ms"
            )
            yield Mistake(f"{place}.max_age_ms", entry.max_age_ms, f"{why}; permitted: no less")


def _priority(config: RackConfig, table: LanConfig) -> Mistakes:
    """Require a priority above the neighbours', if there are real-time ones: else others lose sight
    of this rack.
    """
    others = [place for place in config.tasks() if place.core == table.core and place.board != LAN]
    above = [
        f"{place.name} {place.priority}"
        for place in others
        if place.priority >= max(1, table.priority)
    ]
    if above:
        why = f"must be above that of the other boards on core {table.core}, {', '.join(above)}"
        yield Mistake(
            f"{PLACE}.priority", table.priority, f"{why}: else they keep it from its signs of life"
        )


def _export(wiring: Wiring, source: str) -> Iterator[str]:
    """Yield why a mailbox cannot be exported. A queue is found with the other queues."""
    board = source.partition(".")[0]
    if board == LAN:
        yield "written by the adapter itself; permitted: mailboxes that levels write"
    elif source in wiring.operated:
        yield "what an operator commands stays in its rack; permitted: mailboxes that levels write"
    elif not wiring.is_known(source):
        yield f"no such mailbox; mailboxes: {wiring.names}"
    elif source in wiring.writers and board in wiring.every:
        every = wiring.every[board] * wiring.writers[source][1].cycles
        rate_hz = 1e9 / (every * wiring.config.clock_ns)
        if rate_hz > FASTEST_HZ * (1 + 1e-9):
            why = f"written at {rate_hz:g} Hz, and a loop that fast must not wait for a network"
            yield f"{why}; permitted: up to {FASTEST_HZ:g} Hz: {SLOWER}"


def at_adapter(mistake: Mistake, config: RackConfig) -> Mistake:
    """Return a mistake of the adapter's board with the place that its user knows."""
    table = config.adapter.lan
    if table is None or mistake.place == ITSELF:
        return mistake
    if mistake.place == f"{ITSELF}.executor":
        why = mistake.why if find_spec("zenoh") else INSTALL
        return Mistake(PLACE, None, why)
    port = mistake.place.removeprefix(_MAILBOX)
    if port != mistake.place and port in table.imports:
        return Mistake(f"{PLACE}.import.{port}.type", table.imports[port].type, mistake.why)
    return replace(mistake, place=_OWN.sub(PLACE, mistake.place), why=_OWN.sub(PLACE, mistake.why))


SOON = timedelta(days=30)
"""Time before the end of certificates from which a launch warns."""


def _endpoints(table: LanTable) -> Mistakes:
    """Check the endpoints, judged by the config alone."""
    for key in ("listen", "connect"):
        for at, text in enumerate(getattr(table, key)):
            try:
                why = _why_not(Endpoint.of(text), table, connects=key == "connect")
            except ValueError as error:
                why = str(error)
            if why:
                yield Mistake(f"{PLACE}.{key}[{at}]", text, why)
    if table.estop_from and (exposed := _open(table)):
        could = "pass for any of them"
        if table.certificates is not None:
            could = "repeat what one of them has asked"
        why = f"whoever reaches {exposed[0]} could {could}; permitted: tls/ or quic/ with"
        yield Mistake(
            f"{PLACE}.estop_from",
            ", ".join(table.estop_from),
            f"{why} certificates (rack lan certificates --help), or unix/ on one machine",
        )
    if has_tls(table) and table.certificates is None:
        why = "missing; TLS needs them: see rack lan certificates --help"
        yield Mistake(f"{PLACE}.certificates", None, why)
    if has_tls(table) and table.exports and not table.racks:
        why = "missing; with TLS only racks that it names may import from this one"
        yield Mistake(f"{PLACE}.peers", None, why)


def _open(table: LanTable) -> list[str]:
    """Return the endpoints that others reach without a certificate: every user of this machine
    reaches those of loopback.
    """
    return [str(end) for end in endpoints_of(table) if not (end.has_tls or end.is_private)]


def _why_not(endpoint: Endpoint, table: LanTable, connects: bool) -> str:
    if endpoint.has_tls and connects and ":" in endpoint.host:
        return (
            "zenoh checks no certificate for an address of IPv6; permitted: a host name, or an"
            " address of IPv4"
        )
    if not endpoint.has_tls and has_tls(table):
        return (
            "without TLS, which others have: who comes here is not known; permitted: all with TLS,"
            " or none"
        )
    if endpoint.has_tls or endpoint.is_private or table.insecure:
        return ""
    if not endpoint.is_loopback:
        return (
            "beyond this machine without TLS; permitted: tls/ or quic/ with certificates, an"
            f" address of loopback, or by name, {PLACE}.insecure = true"
        )
    if table.certificates is None:
        return (
            "every user of this machine could pass for any rack here; permitted: unix/ and a name,"
            f" certificates, which seal what is sent, or by name, {PLACE}.insecure = true"
        )
    return ""


def credential_mistakes(config: RackConfig) -> Mistakes:
    """Yield what is wrong with the files of the credentials on this machine, now."""
    table = config.adapter.lan
    if table is None or table.certificates is None:
        return
    try:
        from rack.boards.lan.credentials import Credentials
    except ImportError:
        why = "cannot be checked without 'cryptography': install nasrem-rack[lan]"
        yield Mistake(f"{PLACE}.certificates", table.certificates, why)
        return
    heard = [end for end in endpoints_of(table) if str(end) in table.listen]
    addresses = dict.fromkeys(e.host for e in heard if e.has_tls and not e.is_everywhere)
    for flaw in Credentials(Path(table.certificates), config.name).flaws(addresses):
        # The file first: a long path is cut short.
        yield Mistake(
            f"{PLACE}.certificates", None, f"{flaw.path.name}: {flaw.why}; in {table.certificates}"
        )


def network_notes(config: RackConfig) -> list[str]:
    """Return what a launch says of the network: endpoints without TLS that others can reach,
    certificates that end.
    """
    table = config.adapter.lan
    if table is None:
        return []
    far = _open(table)
    may = "read and forge what is exchanged"
    if table.certificates is not None:
        may = "read what is exchanged, and feign that racks come and go"
    notes = [f"without TLS: whoever reaches {', '.join(far)} may {may}"] if far else []
    if table.certificates is not None and has_tls(table):
        from rack.boards.lan.credentials import Credentials

        expires = Credentials(Path(table.certificates), config.name).expires
        if expires - datetime.now(UTC) < SOON:
            notes.append(
                f"certificates expire on {expires:%Y-%m-%d %H:%M} UTC: the other racks are lost"
                " then"
            )
    return notes
