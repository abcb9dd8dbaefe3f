"""The lab of machines: what passes between them, gets lost, is cut off, and that nothing of it is
left."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from math import sqrt
from pathlib import Path

import pytest

from rack.tools.console.answer import Failure
from tests import network_lab as network
from tests.machine import needs_lab
from tests.network_lab import NAMESPACES, Lab
from tests.processes import BOUND_S, runs, wait_until

PORT = 5000
LISTEN = """
import socket, sys
listening = socket.create_server((sys.argv[1], int(sys.argv[2])))
print("up", flush=True)
print(listening.accept()[0].recv(100).decode())
"""
SAY = """
import socket, sys
socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=20).sendall(b"word")
"""
FLOOD = """
import socket, sys
sender = socket.socket(type=socket.SOCK_DGRAM)
for _ in range(int(sys.argv[3])):
    sender.sendto(b"word", (sys.argv[1], int(sys.argv[2])))
"""
STUBBORN = """
import signal
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("up", flush=True)
signal.pause()
"""
ABANDONED = """
import signal, sys
from tests.network_lab import Lab
with Lab(2) as lab:
    process = lab.popen(0, ["sleep", "1000"])
    print(process.pid, *lab._names, flush=True)
    signal.pause()
"""


def say(lab: Lab, speaker: int, listener: int) -> str:
    """Say a word on one machine to another; return what arrives there."""
    place = lab.address(listener), str(PORT)
    with lab.popen(
        listener, [sys.executable, "-c", LISTEN, *place], stdout=subprocess.PIPE, text=True
    ) as ear:
        assert ear.stdout.readline() == "up\n"
        assert lab.popen(speaker, [sys.executable, "-c", SAY, *place]).wait(BOUND_S) == 0
        return ear.communicate(timeout=BOUND_S)[0].strip()


STRAY = 20
"""Packets that the kernels of the machines send on their own while a test counts: ARP, neighbour
discovery."""


def lost_of(lab: Lab, packets: int) -> int:
    """Return how many of the packets sent by machine 0 do not reach machine 1."""
    before = lab.traffic()
    flood = [sys.executable, "-c", FLOOD, lab.address(1), str(PORT), str(packets)]
    assert lab.popen(0, flood).wait(BOUND_S) == 0
    now = lab.traffic()
    sent, received = (
        now[0].sent_packets - before[0].sent_packets,
        now[1].received_packets - before[1].received_packets,
    )
    assert sent >= packets
    return sent - received


def has_carrier(lab: Lab, machine: int) -> bool:
    """Say whether a machine's own end of its cable is up."""
    with lab.popen(
        machine, ["cat", f"/sys/class/net/{network.LINK}/carrier"], stdout=subprocess.PIPE
    ) as shown:
        return shown.communicate(timeout=BOUND_S)[0] == b"1\n"


@needs_lab
def test_machines_reach_each_other_and_nobody_else() -> None:
    with Lab(3) as lab:
        assert say(lab, 0, 2) == say(lab, 2, 1) == "word"
        assert [traffic.sent_packets > 0 for traffic in lab.traffic()] == [True] * 3
        routes = lab.popen(0, ["ip", "-4", "route"], stdout=subprocess.PIPE, text=True)
        assert [
            line.split()[0] for line in routes.communicate(timeout=BOUND_S)[0].splitlines()
        ] == ["10.77.0.0/24"]


@pytest.mark.slow
@needs_lab
def test_the_share_that_is_asked_for_gets_lost_both_ways() -> None:
    packets, share = 5000, 0.1
    spread = 6 * sqrt(packets * share * (1 - share))
    with Lab(3) as lab:
        lab.lose(2, 0.5)
        assert abs(lost_of(lab, packets)) < STRAY
        for machine in (0, 1):
            lab.lose(machine, share)
            assert abs(lost_of(lab, packets) - share * packets) < spread
            lab.lose(machine, 0)
        assert abs(lost_of(lab, packets)) < STRAY


@needs_lab
def test_a_machine_without_its_cable_knows_it_and_is_back_with_it() -> None:
    with Lab(2) as lab:
        lab.unplug(1)
        assert not has_carrier(lab, 1)
        assert has_carrier(lab, 0)
        lab.plug(1)
        assert has_carrier(lab, 1)
        assert say(lab, 0, 1) == "word"


@needs_lab
def test_what_still_runs_at_the_end_is_ended_and_nothing_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(network, "ENDING", ((signal.SIGTERM, 0.2), (signal.SIGKILL, BOUND_S)))
    with Lab(2) as lab:
        names = [*lab._names, lab._hub]
        assert all((NAMESPACES / name).exists() for name in names)
        obedient = lab.popen(0, ["sleep", "1000"])
        stubborn = lab.popen(1, [sys.executable, "-c", STUBBORN], stdout=subprocess.PIPE, text=True)
        assert stubborn.stdout.readline() == "up\n"
    stubborn.stdout.close()
    assert (obedient.returncode, stubborn.returncode) == (-signal.SIGTERM, -signal.SIGKILL)
    assert not any((NAMESPACES / name).exists() for name in names)


@needs_lab
def test_the_lab_of_a_killed_process_is_removed_by_the_next_one() -> None:
    with (
        Lab(1) as other,
        subprocess.Popen(
            [sys.executable, "-c", ABANDONED], stdout=subprocess.PIPE, text=True
        ) as maker,
    ):
        sleeper, *names = maker.stdout.readline().split()
        wait_until(
            lambda: Path(f"/proc/{sleeper}/comm").read_text() == "sleep\n"
        )  # `ip netns exec` has entered
        maker.kill()
        maker.wait(BOUND_S)
        assert runs(int(sleeper))
        with Lab(1):
            assert not any((NAMESPACES / name).exists() for name in names)
            wait_until(lambda: not runs(int(sleeper)))  # init may reap it later
            # Its process is there.
            assert (NAMESPACES / other._names[0]).exists()


@needs_lab
def test_a_command_that_fails_says_which_and_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network, "NET", "10.77.999")
    with (
        pytest.raises(
            Failure, match=r"network lab: ip -netns rack-lab-\S+ -batch -: .*10\.77\.999\.1/24"
        ),
        Lab(1),
    ):
        pass
    assert not list(NAMESPACES.glob(f"rack-lab-{os.getpid()}-*"))


def test_a_lab_says_why_it_is_not_possible(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert Lab.is_possible() == "no program 'ip'; to install: apt-get install iproute2"
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert Lab.is_possible() == "network namespaces need root"
    with pytest.raises(Failure, match="network lab: network namespaces need root"), Lab(1):
        pass


def test_machines_and_shares_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="0 machines: permitted are 1 to 200"):
        Lab(0)
    with pytest.raises(ValueError, match=r"a share of 1\.5: permitted is 0 to 1"):
        Lab(1).lose(0, 1.5)
