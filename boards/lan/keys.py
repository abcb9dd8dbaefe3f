"""Key expressions on the network; R is the name of the rack, or operator, that sends.

    rack/R/alive/<launch>          liveliness token: gone when the adapter's process ends or is
                                   silent for the lease; in lockstep its cycle follows,
                                   ns, after a hyphen
    rack/R/out/<board>/<port>      an exported mailbox
    rack/R/step                    lockstep: a cycle of R's adapter, with all that it exports
    rack/R/ping/<to>, .../pong/<to>   round trips between clocks
    rack/R/estop/<to>              a query that sets the emergency stop of rack <to>

All begin with the sender's name, so that access control can hold each sender to its own.
"""

from __future__ import annotations

import re

ALL_ALIVE = "rack/*/alive/*"
_ALIVE = re.compile(r"rack/[^/]+/alive/([0-9a-f]{16})(?:-([0-9]{1,18}))?")
_SENDER = re.compile(r"rack/([^/]+)/")


def sender_of(key: str) -> str:
    """Return the name of the sender under a key expression, or an empty string if it has none."""
    found = _SENDER.match(key)
    return found[1] if found else ""


def out_key(rack: str, mailbox: str) -> str:
    """Return the key expression of an exported mailbox."""
    return f"rack/{rack}/out/{mailbox.replace('.', '/')}"


def alive_key(rack: str, launch: int, cycle_ns: int = 0) -> str:
    """Return the key expression of a launch's token; in lockstep with the length of its adapter's
    cycle, ns.
    """
    return f"rack/{rack}/alive/{launch:016x}" + (f"-{cycle_ns}" if cycle_ns else "")


def launch_and_cycle(alive: str) -> tuple[int, int] | None:
    """Return the launch of a token, and the length of its adapter's cycle in ns; 0: it runs in real
    time.

    None for a token that no adapter has made.
    """
    if (found := _ALIVE.fullmatch(alive)) is None:
        return None
    launch, cycle_ns = found.groups()
    return int(launch, 16), int(cycle_ns or 0)


def any_alive(rack: str) -> str:
    """Return the key expression of the tokens of all launches of a rack."""
    return f"rack/{rack}/alive/*"


def step_key(rack: str) -> str:
    """Return the key expression of the cycles of a rack's adapter, in lockstep."""
    return f"rack/{rack}/step"


def ping_key(rack: str, to: str) -> str:
    """Return the key expression of a round trip that a rack begins."""
    return f"rack/{rack}/ping/{to}"


def pong_key(rack: str, to: str) -> str:
    """Return the key expression of a round trip that a rack sends back."""
    return f"rack/{rack}/pong/{to}"


def estop_key(sender: str, to: str) -> str:
    """Return the key expression under which a sender sets the emergency stop of rack `to`."""
    return f"rack/{sender}/estop/{to}"


def estop_answer_key(rack: str, to: str) -> str:
    """Return the key under which rack `rack` seals its answer, so that no request passes for an
    answer.
    """
    return f"rack/{rack}/estop-answer/{to}"
