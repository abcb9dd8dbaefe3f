"""Rules for `[adapter.lan]`: exchanges with other racks, endpoints and certificates.

The table adds a board, `lan`, which is checked like any other. `move_to_adapter` moves its mistakes
to `adapter.lan`, the place that the user wrote.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from pathlib import Path

from rack.backplane.clock.system_clock import compute_period_ticks
from rack.backplane.errors import ClockError
from rack.boards.config.connections import Wiring, is_adapter_name_taken
from rack.boards.config.mistakes import count_repeated_names
from rack.boards.config.schema import LAN, LanConfig, RackConfig
from rack.boards.errors import Mistake, Mistakes
from rack.boards.host.adapter import STATUS
from rack.boards.lan.config import FASTEST_HZ, ExportConfig, ImportConfig, LanTable
from rack.boards.lan.endpoint import Endpoint, has_tls, list_endpoints
from rack.levels.peer import format_peer_port

PLACE = "adapter.lan"
BOARD_PLACE = f"board.{LAN}"
INSTALL = "an exchange with other racks needs eclipse-zenoh: pip install 'nasrem-rack[lan]'"
SLOWER = "export the slower mailboxes of the task and elemental-move levels"
_BOARD_PATTERN = re.compile(rf"\bboard\.{LAN}(\.params)?(?=[.\[]|\b)")
_MAILBOX = f"mailbox {LAN}."


def check_network(wiring: Wiring, table: LanConfig) -> Mistakes:
    """Check the table `[adapter.lan]`, and the mailboxes and message types that it names."""
    yield from _check_endpoints(table)
    if is_adapter_name_taken(wiring.config):
        why = f"[{PLACE}] adds a board of this name; rename this board, or remove one of them"
        yield Mistake(BOARD_PLACE, None, why)
    else:
        yield from _check_board(wiring, table)
    for port, export in table.exports.items():
        for why in _explain_invalid_export(wiring, export.source):
            yield Mistake(f"{PLACE}.export.{port}.from", export.source, why)
    for port, entry in table.imports.items():
        try:
            entry.find_message_class()
        except LookupError as error:
            yield Mistake(f"{PLACE}.import.{port}.type", entry.type, str(error))


def _check_board(wiring: Wiring, table: LanConfig) -> Mistakes:
    """Check names and rates of the exchanges, and in real time the adapter's priority.

    In real time, `protocol.strict` must not be set.
    """
    config = wiring.config
    yield from _check_names(table, config.name)
    if LAN in wiring.periods:
        cycle_ns = wiring.periods[LAN] * config.clock_ns
        for key, entries in (("export", table.exports), ("import", table.imports)):
            for port, entry in entries.items():
                yield from _check_rate(f"{PLACE}.{key}.{port}", entry, cycle_ns)
    if not config.is_lockstep:
        yield from _check_priority(config, table)
        if config.protocol.strict:
            why = (
                "messages of other racks make a run depend on timing, which protocol.strict = true"
                ' refuses; clock.mode must be "lockstep"'
            )
            yield Mistake(PLACE, None, why)


def _check_names(table: LanTable, rack: str) -> Mistakes:
    """Check that the names of racks and ports are unambiguous.

    No mailbox may be listed twice, this rack must not be its own peer, and no port may have the
    name of a mailbox that the adapter itself writes.
    """
    taken = {
        STATUS: "its status",
        **{format_peer_port(other): f"the state of rack '{other}'" for other in table.racks},
    }
    for port, entry in table.imports.items():
        place = f"{PLACE}.import.{port}"
        if port in taken:
            why = f"the adapter writes {taken[port]} under this name; rename the port"
            yield Mistake(place, None, why)
        if entry.rack == rack:
            why = "this mailbox belongs to this rack, whose levels can read it directly"
            yield Mistake(f"{place}.from", entry.source, why)
    for key, entries in (("export", table.exports), ("import", table.imports)):
        for source, count in count_repeated_names(entry.source for entry in entries.values()):
            ports = ", ".join(port for port, entry in entries.items() if entry.source == source)
            why = f"listed {count} times: {ports}; any number of levels may read one port"
            yield Mistake(f"{PLACE}.{key}", source, why)
    if rack in table.peers:
        yield Mistake(f"{PLACE}.peers", rack, "this is the name of this rack itself")
    for port, _ in count_repeated_names(map(format_peer_port, table.racks)):
        equivalent = [other for other in table.racks if format_peer_port(other) == port]
        why = (
            f"these names differ only in '-' and '_', so they would share mailbox {LAN}.{port};"
            " rename a rack"
        )
        yield Mistake(f"{PLACE}.peers", equivalent, why)


def _check_rate(place: str, entry: ExportConfig | ImportConfig, cycle_ns: int) -> Mistakes:
    """Check that the rate of an exchange divides the adapter's rate.

    For an import, also check that messages cannot get too old between two exchanges.

    Args:
        place: Place of the entry in the config.
        entry: The export or import.
        cycle_ns: Period of the adapter's board in ns of simulated time.
    """
    grid = ("of the adapter", "cycle")
    try:
        every = compute_period_ticks(entry.rate_hz, cycle_ns, "exchange", grid, FASTEST_HZ)
    except ClockError as error:
        yield Mistake(f"{place}.rate_hz", entry.rate_hz, str(error))
        return
    if isinstance(entry, ImportConfig):
        least_ms = (every + 1) * cycle_ns * 1e-6
        if entry.max_age_ms < least_ms:
            why = (
                "between two exchanges a message gets as old as their interval and one cycle of"
                f" the adapter; must be at least {least_ms:.12g} ms"
            )
            yield Mistake(f"{place}.max_age_ms", entry.max_age_ms, why)


def _check_priority(config: RackConfig, table: LanConfig) -> Mistakes:
    """Check that the adapter has a higher priority than the real-time boards on its core.

    If they delayed its heartbeats, other racks would consider this rack lost.
    """
    if above := [
        f"{place.name} {place.priority}"
        for place in config.list_tasks()
        if place.core == table.core
        and place.board != LAN
        and place.priority >= max(1, table.priority)
    ]:
        why = (
            f"must be above the other boards on core {table.core}, {', '.join(above)}; otherwise"
            " they can delay its signs of life"
        )
        yield Mistake(f"{PLACE}.priority", table.priority, why)


def _explain_invalid_export(wiring: Wiring, source: str) -> Iterator[str]:
    """Yield the reason why a mailbox cannot be exported, or nothing if it can.

    Exported queues are reported by `check_queues`.
    """
    board = source.partition(".")[0]
    if board == LAN:
        yield "the adapter itself writes it; only mailboxes of levels can be exported"
    elif source in wiring.operator_mailboxes:
        yield "operator commands stay in their rack; only mailboxes of levels can be exported"
    elif not wiring.is_known(source):
        yield f"no such mailbox; mailboxes: {', '.join(wiring.types)}"
    elif source in wiring.writers and board in wiring.periods:
        every = wiring.periods[board] * wiring.writers[source][1].cycles
        rate_hz = 1e9 / (every * wiring.config.clock_ns)
        if rate_hz > FASTEST_HZ * (1 + 1e-9):
            why = f"written at {rate_hz:g} Hz, too fast for a loop over a network, which can run at"
            yield f"{why} up to {FASTEST_HZ:g} Hz; {SLOWER}"


def move_to_adapter(mistake: Mistake, config: RackConfig) -> Mistake:
    """Return a mistake in which `board.lan` is replaced by `adapter.lan`, which the user wrote."""
    table = config.adapter.lan
    if table is None or mistake.place == BOARD_PLACE:
        return mistake
    if mistake.place == f"{BOARD_PLACE}.executor":
        return Mistake(PLACE, None, mistake.why if find_spec("zenoh") else INSTALL)
    port = mistake.place.removeprefix(_MAILBOX)
    if port != mistake.place and port in table.imports:
        return Mistake(f"{PLACE}.import.{port}.type", table.imports[port].type, mistake.why)
    return replace(
        mistake,
        place=_BOARD_PATTERN.sub(PLACE, mistake.place),
        why=_BOARD_PATTERN.sub(PLACE, mistake.why),
    )


EXPIRY_WARNING = timedelta(days=30)
"""A launch warns about certificates that expire within this time."""


def _check_endpoints(table: LanTable) -> Mistakes:
    """Check that endpoints are valid and protected, without reading certificate files."""
    for key in ("listen", "connect"):
        for at, text in enumerate(getattr(table, key)):
            try:
                why = _explain_unsafe_endpoint(Endpoint.from_text(text), table, key)
            except ValueError as error:
                why = str(error)
            if why:
                yield Mistake(f"{PLACE}.{key}[{at}]", text, why)
    if table.estop_from and (exposed := _list_open_endpoints(table)):
        attack = "impersonate any of these racks"
        if table.certificates is not None:
            attack = "repeat an earlier request of one of these racks"
        why = f"whoever reaches {exposed[0]} could {attack}; use tls/ or quic/ with"
        yield Mistake(
            f"{PLACE}.estop_from",
            ", ".join(table.estop_from),
            f"{why} certificates (rack lan certificates --help), or unix/ on one machine",
        )
    if has_tls(table) and table.certificates is None:
        why = "missing; TLS needs certificates: see rack lan certificates --help"
        yield Mistake(f"{PLACE}.certificates", None, why)
    if has_tls(table) and table.exports and not table.racks:
        why = "missing; with TLS only racks listed here may import from this one"
        yield Mistake(f"{PLACE}.peers", None, why)


def _list_open_endpoints(table: LanTable) -> list[str]:
    """Return the endpoints that others can reach without a certificate.

    These include loopback addresses, which every user of this machine can reach.
    """
    return [str(end) for end in list_endpoints(table) if not (end.has_tls or end.is_private)]


def _explain_unsafe_endpoint(endpoint: Endpoint, table: LanTable, key: str) -> str:
    """Return the reason why an endpoint is not protected well enough. Empty if it is.

    Args:
        endpoint: The endpoint.
        table: The table `[adapter.lan]`.
        key: Key of the table that contains the endpoint: "listen" or "connect".
    """
    if endpoint.has_tls and key == "connect" and ":" in endpoint.host:
        return (
            "zenoh does not check certificates of IPv6 addresses; use a host name or an IPv4"
            " address"
        )
    if not endpoint.has_tls and has_tls(table):
        return (
            "this endpoint has no TLS but others have it, so its peers are not authenticated; use"
            " TLS for all endpoints or for none"
        )
    if endpoint.has_tls or endpoint.is_private or table.insecure:
        return ""
    if not endpoint.is_loopback:
        return (
            "other machines can reach this endpoint without TLS; use tls/ or quic/ with"
            f" certificates or a loopback address, or accept it with {PLACE}.insecure = true"
        )
    if table.certificates is None:
        return (
            "every user of this machine could impersonate another rack; use unix/ and a name or"
            f" certificates, which protect messages, or accept it with {PLACE}.insecure = true"
        )
    return ""


def check_credentials(config: RackConfig) -> Mistakes:
    """Check that the certificate files on this machine exist and are valid now."""
    table = config.adapter.lan
    if table is None or table.certificates is None:
        return
    try:
        from rack.boards.lan.credentials import Credentials
    except ImportError:
        why = "cannot be checked without 'cryptography': install nasrem-rack[lan]"
        yield Mistake(f"{PLACE}.certificates", table.certificates, why)
        return
    heard = [end for end in list_endpoints(table) if str(end) in table.listen]
    addresses = dict.fromkeys(e.host for e in heard if e.has_tls and not e.is_wildcard)
    for flaw in Credentials(Path(table.certificates), config.name).find_flaws(addresses):
        # The file name comes first, because long texts are cut off at the end.
        yield Mistake(
            f"{PLACE}.certificates", None, f"{flaw.path.name}: {flaw.why}; in {table.certificates}"
        )


def list_network_notes(config: RackConfig) -> Iterator[str]:
    """Yield notes for the launch about open endpoints and certificates that expire soon."""
    table = config.adapter.lan
    if table is None:
        return
    exposed = _list_open_endpoints(table)
    attack = "read and forge messages"
    if table.certificates is not None:
        attack = "read messages, and pretend that racks come and go"
    if exposed:
        yield f"no TLS: whoever reaches {', '.join(exposed)} can {attack}"
    if table.certificates is not None and has_tls(table):
        from rack.boards.lan.credentials import Credentials

        expires = Credentials(Path(table.certificates), config.name).expiry_time
        if expires - datetime.now(UTC) < EXPIRY_WARNING:
            yield (
                f"certificates expire on {expires:%Y-%m-%d %H:%M} UTC; after that the other racks"
                " are lost"
            )
