"""Key expressions on the network. R is the name of the rack or operator that sends.

    rack/R/alive/<launch>             liveliness token; expires when the adapter's process ends or
                                      is silent for the lease. In lockstep, a hyphen and the
                                      length of the adapter's cycle in ns follow.
    rack/R/out/<board>/<port>         an exported mailbox
    rack/R/step                       lockstep: one cycle of R's adapter with all its exports
    rack/R/ping/<to>, .../pong/<to>   round trips between clocks
    rack/R/estop/<to>                 a query that sets the emergency stop of rack <to>

Every key contains the sender's name, so access control can restrict a sender to its own keys.
"""

from __future__ import annotations

import re

ALL_ALIVE = "rack/*/alive/*"
_ALIVE = re.compile(r"rack/[^/]+/alive/([0-9a-f]{16})(?:-([0-9]{1,18}))?")
_SENDER = re.compile(r"rack/([^/]+)/")


def parse_sender(key: str) -> str:
    """Return the sender's name in a key expression. Empty if the expression contains none."""
    match = _SENDER.match(key)
    return match[1] if match else ""


def out_key(rack: str, mailbox: str) -> str:
    """Return the key expression of an exported mailbox."""
    return f"rack/{rack}/out/{mailbox.replace('.', '/')}"


def alive_key(rack: str, launch: int, cycle_ns: int = 0) -> str:
    """Return the key expression of a launch's liveliness token.

    Args:
        rack: Name of the rack.
        launch: Number of the launch, at most 64 bits.
        cycle_ns: Length of the adapter's cycle in ns in lockstep. 0 in real time.
    """
    return f"rack/{rack}/alive/{launch:016x}" + (f"-{cycle_ns}" if cycle_ns else "")


def parse_alive_key(alive: str) -> tuple[int, int] | None:
    """Parse the key expression of a liveliness token.

    Returns:
        The launch number and the length of the adapter's cycle in ns, which is 0 in real time. None
        if the key is malformed.
    """
    if (match := _ALIVE.fullmatch(alive)) is None:
        return None
    launch, cycle_ns = match.groups()
    return int(launch, 16), int(cycle_ns or 0)


def alive_pattern(rack: str) -> str:
    """Return the key expression that matches the tokens of all launches of a rack."""
    return f"rack/{rack}/alive/*"


def step_key(rack: str) -> str:
    """Return the key expression of a rack's steps in lockstep."""
    return f"rack/{rack}/step"


def ping_key(rack: str, to: str) -> str:
    """Return the key expression under which a rack pings rack `to`."""
    return f"rack/{rack}/ping/{to}"


def pong_key(rack: str, to: str) -> str:
    """Return the key expression under which a rack answers the pings of rack `to`."""
    return f"rack/{rack}/pong/{to}"


def estop_key(sender: str, to: str) -> str:
    """Return the key expression under which a sender requests an emergency stop of rack `to`."""
    return f"rack/{sender}/estop/{to}"


def estop_answer_key(rack: str, to: str) -> str:
    """Return the key expression that a rack seals into its answer to an emergency-stop request.

    It differs from the request's key expression, so that a request cannot be replayed as an answer.
    """
    return f"rack/{rack}/estop-answer/{to}"
