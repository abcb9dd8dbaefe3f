"""`rack estop`: the emergency stop of a running rack."""

from __future__ import annotations

import sys
import time

from rack.backplane.lines import UtilityLines
from rack.backplane.process import wait_readable
from rack.backplane.segment import Segment
from rack.backplane.words import Demand, Run, System
from rack.tools.console.address import OPERATOR, Operator, RackAddress
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.held import describe_wait
from rack.tools.console.parameters import (
    Json,
    argument,
    check_rack_name,
    complete_rack_name,
    option,
)

MAX_RESPONSE_S = 2.0
"""Maximum time within which the clock, which reads the latch every tick, must apply it."""


def estop(
    rack: str = argument(
        "RACK",
        "running rack by name, as 'rack list' shows it; on another machine: HOST[:PORT]/RACK",
        autocompletion=complete_rack_name,
        callback=check_rack_name,
    ),
    reset: bool = option("--reset", "clear the latch, so that the arm may move again", False),
    ready: bool = option(
        "--ready", "for HOST/RACK: connect now, and stop the rack when Enter is pressed", False
    ),
    certificates: str = option(
        "--certificates DIR",
        "for HOST/RACK: folder with certificates; see rack lan certificates --help",
        "",
        envvar="RACK_CERTIFICATES",
    ),
    name: str = option(
        "--as NAME", "for HOST/RACK: your name, as in adapter.lan.estop_from of that rack", OPERATOR
    ),
    as_json: Json = False,
) -> None:
    """Engage the brakes of the arm at once, and keep them engaged until --reset.

    The run continues with the arm braked. The reset is refused while a board is lost, or SYSFAIL or
    ACFAIL is asserted. A rack on another machine, HOST/RACK, can be stopped by the operators whom
    its config names in adapter.lan.estop_from. It must be reset on its own machine. Anyone who can
    reach the network port of a rack can delay new connections. --ready therefore connects in
    advance, and reports on stderr whenever the connection is lost or restored. Pressing Enter (any
    line on stdin) then sets the stop at once, or as soon as the rack can be reached. Ctrl-C exits
    without a stop.

    The arm of a rack that is held between two ticks brakes when the rack continues.

    Exit status: 0 the latch is set, or with --reset clear; 1 the reset was refused, or there is no
    such rack.

    \b
    Examples:
      rack estop nasrem
      rack estop nasrem --reset
      rack estop 192.168.1.5/cell --certificates ~/cell
      rack estop 192.168.1.5/cell --certificates ~/cell --ready
    """
    if ready and (reset or "/" not in rack):
        other = "--reset" if reset else rack
        raise Failure(
            f"--ready, {other}: --ready only stops a rack on another machine, HOST/RACK", 2
        )
    if "/" in rack:
        tick = _stop_remote_rack(
            RackAddress.parse_address(rack), reset, ready, Operator.from_options(name, certificates)
        )
        rack_name = rack.partition("/")[2]
        wait_reason = ""
    else:
        tick, wait_reason = _set_latch(rack, reset)
        rack_name = rack
    where = ", on its own machine" if rack_name != rack else ""
    state = f"reset at tick {tick}" if reset else f"latched at tick {tick}"
    if wait_reason:
        state += f"; the arm {wait_reason}"
    if not reset:
        state += f"; to release{where}: rack estop {rack_name} --reset"
    document = {"rack": rack_name, "emergency_stop": not reset, "tick": tick, "waits": wait_reason}
    print_answer(document, f"rack '{rack}': emergency stop {state}", as_json)


def _stop_remote_rack(address: RackAddress, reset: bool, ready: bool, operator: Operator) -> int:
    """Set the latch of a rack on another machine, at once or when Enter is pressed.

    Args:
        address: The rack.
        reset: Must be False: a reset from another machine is refused.
        ready: True to connect first and wait for Enter.
        operator: Identity under which the rack is stopped.

    Returns:
        The tick at which the latch was set.

    Raises:
        Failure: The reset is refused, or a package is missing.
    """
    if reset:
        rack = address.rack
        why = f"can only be reset on its own machine: rack estop {rack} --reset"
        raise Failure(f"rack '{rack}' {why}")
    try:
        from rack.tools.network.estop import stop_rack, stop_when
    except ImportError as error:
        if error.name not in ("zenoh", "cryptography"):
            raise
        raise Failure(
            "racks on other machines need zenoh and cryptography: pip install nasrem-rack[lan]"
        ) from None
    return (
        stop_when(_wait_for_enter, address, operator, _ChangePrinter())
        if ready
        else stop_rack(address, operator)
    )


class _ChangePrinter:
    """Prints a line on stderr if it differs from the previous line."""

    def __init__(self) -> None:
        self._last = ""

    def __call__(self, line: str) -> None:
        if line != self._last:
            print(line, file=sys.stderr, flush=True)
        self._last = line


def _wait_for_enter(wait_s: float) -> bool:
    """Wait up to `wait_s` for a line on stdin, and return True if a line was read.

    Raises `Failure` at the end of the input.
    """
    if not wait_readable(sys.stdin.fileno(), wait_s):
        return False
    if not sys.stdin.readline():
        raise Failure("stdin has ended before a stop was set")
    return True


def _set_latch(rack: str, reset: bool) -> tuple[int, str]:
    """Set or clear the latch of a rack on this machine, and wait until the clock has applied it.

    Returns:
        The current tick, and the reason why the arm does not react yet if the rack is held. The
        reason is empty if the rack is not held.
    """
    segment = Segment.attach(rack)
    words = segment.words
    lines = UtilityLines(segment)
    if segment.run_is_over:
        raise Failure(f"rack '{rack}': its run is over")
    if reset:
        lines.reset_emergency_stop()
    else:
        lines.latch_emergency_stop()
    deadline = time.monotonic() + MAX_RESPONSE_S
    # The clock updates the demand on the arm at its next tick. A lost board can demand brakes, too.
    wait_reason = ""
    while (words[System.DEMAND] == Demand.BRAKE) == reset and words[System.STATE] == Run.RUNNING:
        if wait_reason := describe_wait(segment):
            break
        if time.monotonic() > deadline:
            raise Failure(
                f"rack '{rack}': the latch is {'clear' if reset else 'set'}, but the clock has not"
                f" obeyed within {MAX_RESPONSE_S:g} s"
            )
        time.sleep(0.001)
    return words[System.TICK], wait_reason
