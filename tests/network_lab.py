"""A lab of machines on one network: namespaces joined by a bridge, whose cables can be pulled and
lose packets.

The bridge has a namespace of its own, so nothing of this machine's network changes, and no address
can clash with its addresses. Packets get lost on the bridge, as on a wire: a machine's kernel would
notice that it drops its own. Names carry the process that made the lab. What a killed one has left,
the next lab removes.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, Self

from rack.backplane.process import wait_readable
from rack.tools.console.answer import Failure
from tests.processes import parent_of

PREFIX = "rack-lab"
NAMESPACES = Path("/run/netns")
NET = "10.77.0"
"""The first three parts of all addresses."""
ENDING = ((signal.SIGTERM, 5.0), (signal.SIGKILL, 2.0))
"""Signals to processes that are left at the end, and the time that they have after each, s."""
PATIENCE_S = 30.0
"""Longest time that one call of `ip` or `nft` may take."""
LINK = "lan"
"""The network interface of every machine."""
_NUMBERS = count()


def _read_start_time(pid: str) -> str:
    """Start time of a process, in kernel clock ticks since boot; empty if there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (FileNotFoundError, ProcessLookupError):
        return ""


class Lab:
    """Machines 0 to `machines` - 1, each a network namespace. Raises `Failure` where a command for
    one fails."""

    def __init__(self, machines: int) -> None:
        pid = os.getpid()
        lab = f"{PREFIX}-{pid}-{_read_start_time(str(pid))}-{next(_NUMBERS)}"
        self._hub = f"{lab}-hub"
        self._names = [f"{lab}-{number}" for number in range(machines)]
        self._started: list[subprocess.Popen[Any]] = []
        self._losses: dict[int, float] = {}

    @staticmethod
    def is_possible() -> str:
        """Return why this process cannot have a lab, empty if it can."""
        if os.geteuid():
            return "network namespaces need root"
        for program, package in {"ip": "iproute2", "nft": "nftables"}.items():
            if shutil.which(program) is None:
                return f"no program '{program}'; to install: apt-get install {package}"
        return ""

    def __enter__(self) -> Self:
        if why_not := self.is_possible():
            raise Failure(f"network lab: {why_not}")
        _remove(_stale())
        try:
            self._build()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._close()

    def _build(self) -> None:
        _ip([f"netns add {name}" for name in (self._hub, *self._names)])
        # Neither asks who is there, nor takes an IPv6 address: all packets are those of the
        # machines.
        links = ["link add hub type bridge mcast_snooping 0", "link set hub addrgenmode none up"]
        for number, name in enumerate(self._names):
            links.append(f"link add {_cable(number)} type veth peer name {LINK} netns {name}")
            links.append(f"link set {_cable(number)} master hub addrgenmode none up")
        _ip(links, self._hub)
        for number, name in enumerate(self._names):
            own = [
                f"address add {self.address(number)}/24 dev {LINK}",
                f"link set {LINK} addrgenmode none up",
            ]
            _ip(["link set lo up", *own], name)

    def _close(self) -> None:
        _remove([*self._names, self._hub])
        for process in self._started:
            process.poll()

    def __len__(self) -> int:
        return len(self._names)

    def address(self, machine: int) -> str:
        """Return the IPv4 address of a machine, which others can reach."""
        return f"{NET}.{machine + 1}"

    def popen(self, machine: int, argv: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
        """Start a process on a machine; `options` are those of `Popen`. Should it be left at the
        end, it is ended."""
        process = subprocess.Popen(["ip", "netns", "exec", self._names[machine], *argv], **options)
        self._started.append(process)
        return process

    def lose(self, machine: int, share: float) -> None:
        """Drop that share of all packets to and from a machine, at random; 0 ends it."""
        self._losses[machine] = share
        rules = [
            f'{way} "{_cable(number)}" numgen random mod 1000000 < {round(lost * 1e6)} drop'
            for number, lost in self._losses.items()
            if lost
            for way in ("iifname", "oifname")
        ]
        chain = ["chain wire {", "type filter hook forward priority 0", *rules, "}"]
        # All at once: the rules before this are gone, these are in force.
        renewed = ["table bridge loss", "delete table bridge loss", "table bridge loss {"]
        script = [*renewed, *chain, "}"]
        _call(["ip", "netns", "exec", self._hub, "nft", "--file", "-"], script)

    def unplug(self, machine: int) -> None:
        """Pull the cable of a machine, which sees that its link is down."""
        _ip([f"link set {_cable(machine)} down"], self._hub)

    def plug(self, machine: int) -> None:
        """Plug the cable of a machine in again."""
        _ip([f"link set {_cable(machine)} up"], self._hub)


def _cable(machine: int) -> str:
    """Return the name of the bridge's end of a machine's cable."""
    return f"cable{machine}"


def _ip(commands: Iterable[str], namespace: str | None = None) -> None:
    where = ["-netns", namespace] if namespace else []
    _call(["ip", *where, "-batch", "-"], commands)


def _call(argv: Sequence[str], lines: Iterable[str]) -> None:
    """Run a command with these lines as its input. Raises `Failure`."""
    called = f"network lab: {' '.join(argv)}"
    text = "".join(f"{line}\n" for line in lines)
    try:
        done = subprocess.run(argv, input=text, capture_output=True, text=True, timeout=PATIENCE_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Failure(f"{called}: {error}") from None
    if done.returncode:
        why = " ".join(done.stderr.split()) or f"exit status {done.returncode}"
        raise Failure(f"{called}: {why}")


def _stale() -> list[str]:
    """Return the namespaces of labs whose process is gone."""
    found = []
    for path in NAMESPACES.glob(f"{PREFIX}-*"):
        pid, started = path.name.removeprefix(f"{PREFIX}-").split("-")[:2]
        if _read_start_time(pid) != started:
            found.append(path.name)
    return found


def _remove(names: Sequence[str]) -> None:
    """Remove namespaces, and end what still runs in them."""
    there = [name for name in names if (NAMESPACES / name).exists()]
    _end(there)
    for name in there:
        # Another lab may have removed a stale one meanwhile.
        subprocess.run(
            ["ip", "netns", "delete", name], stderr=subprocess.DEVNULL, timeout=PATIENCE_S
        )


def _end(names: Sequence[str]) -> None:
    """End the processes in namespaces: those that started others first, which end these in
    order."""
    for how, patience_s in ENDING:
        deadline = time.monotonic() + patience_s
        struck = set[int]()
        while (inside := _inside(names)) and time.monotonic() < deadline:
            roots = {
                pid
                for pid, parent in inside.items()
                if how is signal.SIGKILL or parent not in inside
            }
            for pid in roots - struck:
                with suppress(ProcessLookupError):
                    os.kill(pid, how)
            struck |= roots
            _await_end(next(iter(inside)))


def _inside(names: Sequence[str]) -> dict[int, int]:
    """Return the processes in namespaces, each with its parent."""
    found: dict[int, int] = {}
    for name in names:
        command = ["ip", "netns", "pids", name]
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
        for pid in map(int, done.stdout.split()):
            # It may have ended.
            with suppress(OSError):
                found[pid] = parent_of(pid)
    return found


def _await_end(pid: int) -> None:
    """Wait a little for the end of a process."""
    try:
        pidfd = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        wait_readable(pidfd, 0.1)
    finally:
        os.close(pidfd)
