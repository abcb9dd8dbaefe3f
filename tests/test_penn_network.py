"""The rack penn in real time, commanded by a client in another process over TCP: with a delay, and
with a connection that is lost while the tool presses."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.segment import Segment
from rack.levels.systems.force.messages import Mode
from rack.tools.viewer.window import find_free_port
from tests.machine import needs_fifo, needs_lab
from tests.network_lab import Lab
from tests.processes import RACK, wait_until

pytestmark = [pytest.mark.thorough, pytest.mark.alone]

ROOT = Path(__file__).parents[1]
NAME = f"test-penn-{os.getpid()}"
BOUND_S = 90.0
DELAY_MS = 50
HELD_S = 3.0
FIRST = """
x, y, _ = where()
line((x, y, 0.62), (0.0, 0.0, 1.0, 0.0))
line((0.5, -0.25, 0.62), (0.0, 0.0, 1.0, 0.0))
guard("touch")
line((0.5, -0.25, 0.48), (0.0, 0.0, 1.0, 0.0), segment=2.0)
comply("wipe", wrench={"z": 15.0})
wiping = line((0.5, 0.02, 0.5), (0.0, 0.0, 1.0, 0.0), segment=60.0)
wait(wiping)
raise RuntimeError(end_of(wiping).name)
"""
"""Touches the surface, presses, and moves along it until the connection is lost."""
SECOND = """
wait(free())
x, y, _ = where()
wait(line((x, y, 0.62), (0.0, 0.0, 1.0, 0.0)))
"""
Start = Callable[[Sequence[str]], subprocess.Popen[bytes]]


@contextmanager
def local() -> Iterator[tuple[str, str, Start, Start, Callable[[], None], Callable[[], None]]]:
    """Both on this machine, with a relay that delays, and whose end is the loss."""
    port, delayed = find_free_port(), find_free_port()
    relay = subprocess.Popen(
        [sys.executable, "-m", "tests.slow_link", str(delayed), str(port), str(DELAY_MS)], cwd=ROOT
    )

    def start(argv: Sequence[str]) -> subprocess.Popen[bytes]:
        return subprocess.Popen(argv, cwd=ROOT)

    try:
        end = relay.kill
        yield f"127.0.0.1:{port}", f"127.0.0.1:{delayed}", start, start, end, lambda: None
    finally:
        relay.kill()
        relay.wait()


@contextmanager
def machines() -> Iterator[tuple[str, str, Start, Start, Callable[[], None], Callable[[], None]]]:
    """The rack and its client on two machines, one of which loses every twentieth packet until its
    cable is pulled."""
    with Lab(2) as lab:
        lab.lose(1, 0.05)
        address = f"{lab.address(0)}:7260"

        def start(machine: int) -> Start:
            return lambda argv: lab.popen(machine, argv, cwd=ROOT)

        yield (
            address,
            address,
            start(0),
            start(1),
            lambda: lab.unplug(1),
            lambda: lab.plug(1),
        )


class Watched:
    """The rack, as far as its statuses tell."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._ring: MailboxRing | None = None
        self.modes: list[int] = []
        self.forces: list[float] = []

    def look(self) -> bool:
        """Read new statuses of the server. Return False before the rack has any."""
        if self._ring is None:
            with suppress(Exception):
                self._ring = MailboxRing(Segment.attach(self._name), "server.status")
            return False
        rows: Any = self._ring.read_new_rows().rows
        self.modes += rows["message"]["mode"].tolist()
        self.forces += rows["message"]["wrench"][:, 2].tolist()
        return bool(self.modes)


@needs_fifo
@pytest.mark.parametrize("place", [local, pytest.param(machines, marks=needs_lab)])
def test_a_lost_client_leaves_the_force_held_and_released_and_the_next_one_goes_on(
    place: Any, tmp_path: Path
) -> None:
    for name, text in (("first", FIRST), ("second", SECOND)):
        (tmp_path / f"{name}.py").write_text(text)
    with ExitStack() as stack:
        listen, address, start_rack, start_client, lose, restore = stack.enter_context(place())
        client = [sys.executable, "-m", "rack.levels.systems.force.network_client"]
        settings = [f"name={NAME}", "host.coordinator.params.script=", "clock.speed=0.5"]
        settings.append(f"host.coordinator.params.listen={listen}")
        options = [word for setting in settings for word in ("--set", setting)]
        rack = start_rack([*RACK, "run", "penn", "--no-record", *options])
        watched = Watched(NAME)
        wait_until(watched.look, BOUND_S)
        clients = []

        def is_served() -> bool:
            if not clients or clients[-1].poll() is not None:
                clients.append(start_client([*client, address, str(tmp_path / "first.py")]))
            watched.look()
            return Mode.FORCE in watched.modes and 12.0 < watched.forces[-1] < 18.0

        wait_until(is_served, BOUND_S)
        lose()
        since = len(watched.modes)
        wait_until(lambda: watched.look() and watched.modes[-1] == Mode.RELEASED, BOUND_S)
        # 50 statuses a second of simulated time.
        after = watched.modes[since:]
        assert [mode for mode in Mode if mode in after] == [
            Mode.FORCE,
            Mode.HELD,
            Mode.RELEASING,
            Mode.RELEASED,
        ]
        assert after.count(Mode.HELD) == pytest.approx(50 * HELD_S, rel=0.1)
        wait_until(lambda: watched.look() and abs(watched.forces[-1]) < 1.0, BOUND_S)
        assert rack.poll() is None
        restore()
        assert clients[-1].wait(BOUND_S) == 1
        link = listen if place is local else address
        second = start_client([*client, link, str(tmp_path / "second.py")])
        assert (second.wait(BOUND_S), rack.wait(BOUND_S)) == (0, 0)
        watched.look()
        assert watched.modes[-1] == Mode.MOTION
