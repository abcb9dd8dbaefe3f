"""`rack prompt`: open a Python prompt, or run a script, on the host side of a running rack."""

from __future__ import annotations

import code
import contextlib
import os
import runpy
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rack.backplane.segment import Segment
from rack.boards.config.loader import load_text
from rack.boards.config.resolved import resolve
from rack.boards.errors import MAX_REASON_LENGTH, to_one_line
from rack.boards.host.bus import HostBus
from rack.boards.wiring import HostWiring
from rack.levels.host_program import HostProgram
from rack.levels.references import find_class
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT, SIGNALS
from rack.tools.console.parameters import RackName, argument


def prompt(
    rack: RackName,
    board: str | None = argument(
        "BOARD", "external host board; not needed when the rack has one", None
    ),
    script: Path | None = argument(
        "SCRIPT", "Python script to run, in place of a prompt", None, dir_okay=False
    ),
) -> None:
    """Open a Python prompt, or run a script, on the host side of a running rack.

    The prompt runs as the process of a host board with `external = true`. A board can have only one
    such process at a time. The name `program` is the board's program, whose ports read and send
    messages, and `bus` gives the time, waits for messages, reads the crate's memory by address and
    writes the scratch words of the board. The program may define more names.
    Nothing that happens at the prompt delays the real-time side. The prompt can be closed and
    opened again while the rack runs. The rack must belong to you, because the prompt runs a class
    that the rack's config names.

    Exit status: 0 prompt closed; 1 there is no such rack, it belongs to another user, the board is
    in use, or the script failed; 2 usage.

    \b
    Examples:
      rack prompt chimera
      rack prompt chimera command stream.py
    """
    segment = Segment.attach(rack)
    if segment.run_is_over:
        raise Failure(f"rack '{rack}': the run is over")
    if (owner := os.fstat(segment.fd).st_uid) != os.getuid():
        why = "only that user may run the program that its config names"
        raise Failure(f"rack '{rack}' belongs to user {owner}: {why}")
    wiring = _find_wiring(segment, board)
    program = find_class(wiring.target, HostProgram)(wiring.context)
    bus = HostBus(segment, wiring)
    bus.connect_ports(program)
    names = {"bus": bus, "program": program, **program.list_prompt_names(bus)}
    try:
        with _use_python_signals():
            if script is None:
                _open_prompt(rack, wiring.board, names)
            else:
                _run_script(script, names)
    finally:
        bus.close()


def _find_wiring(segment: Segment, board: str | None) -> HostWiring:
    """Return the wiring of the external host board.

    If `board` is None, the rack must have exactly one. Raises `Failure`.
    """
    wirings = {
        host.board: host for host in resolve(load_text(segment.config)).hosts if host.is_external
    }
    names = ", ".join(wirings) or "none"
    if board is None and len(wirings) != 1:
        raise Failure(f"BOARD is missing; external host boards of '{segment.rack}': {names}", 2)
    if board is not None and board not in wirings:
        raise Failure(
            f"BOARD = {board}: must be an external host board of '{segment.rack}': {names}",
            2,
        )
    return wirings[board or next(iter(wirings))]


@contextlib.contextmanager
def _use_python_signals() -> Iterator[None]:
    """Handle signals as Python's prompt and scripts expect: Ctrl-C raises `KeyboardInterrupt`."""
    previous = {number: signal.getsignal(number) for number in SIGNALS}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


class Prompt(code.InteractiveConsole):
    """Python prompt that prints an error inside a call of a name that it offers in one line."""

    def showtraceback(self) -> None:
        """Print the exception that was just raised."""
        error = sys.exc_info()[1]
        frames = traceback.extract_tb(error.__traceback__) if error is not None else []
        if isinstance(error, ValueError | LookupError) and frames[-1].filename != self.filename:
            self.write(f"{to_one_line(str(error), MAX_REASON_LENGTH)}\n")
        else:
            super().showtraceback()


def _open_prompt(rack: str, board: str, names: dict[str, Any]) -> None:
    """Open a prompt in which `names` are defined."""
    with contextlib.suppress(ImportError):
        import readline  # noqa: F401  line editing and history

    names_text = ", ".join(names)
    banner = f"rack {rack}, host board '{board}': {names_text}; help(NAME) explains a name"
    Prompt(names).interact(banner, exitmsg="")


def _run_script(script: Path, names: dict[str, Any]) -> None:
    """Run a script. Raises `Failure` with the exception that ended it, in one line."""
    if not script.is_file():
        raise Failure(f"{script}: no such file", 2)
    try:
        runpy.run_path(str(script), names, "__main__")
    except KeyboardInterrupt:
        sys.exit(INTERRUPT.number or 128 + signal.SIGINT)
    except Exception as error:
        raise Failure(f"{script}: {type(error).__name__}: {error}") from error
