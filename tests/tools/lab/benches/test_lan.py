"""The bench of the network: real links in a lab, what goes wrong with one contestant, and the
figures."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from rack.tools.console.progress import Progress
from rack.tools.lab.benches import lan
from rack.tools.lab.benches.harness import Absent
from rack.tools.lab.benches.lan import LanRuns, measure
from rack.tools.lab.benches.lan_ends import (
    COORDINATOR,
    LEASE_MS,
    ORDER_BYTES,
    STATUS_BYTES,
)
from rack.tools.lab.benches.lan_figures import LanFigures, Point, Steadiness
from rack.tools.lab.benches.lan_group import Group
from rack.tools.lab.benches.lan_machine import ENDS, TLS
from rack.tools.lab.benches.network import NAMESPACES, Lab
from tests.machine import needs_lab
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough

UDP_BYTES = ORDER_BYTES + STATUS_BYTES + 2 * 42
"""An order and a status with their UDP, IP and Ethernet headers."""
RATE_HZ, CYCLES = 50.0, 15


@pytest.mark.slow
@needs_lab
def test_racks_are_measured_next_to_others_and_who_fails_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(lan, "ENDS", {TLS: ENDS[TLS], "UDP": ENDS["UDP"], "nobody": "none"})
    monkeypatch.setattr(lan, "DEATHS", 1)
    monkeypatch.setattr(lan, "IDLE_S", 0.3)
    found = measure(LanRuns((1,), (RATE_HZ,), CYCLES / RATE_HZ, 1, 0.0), Progress())
    for who in (TLS, "UDP"):
        assert len(found.values[Point("round trip", 1, RATE_HZ, who, "us")]) == CYCLES
        # Both machines, but for what comes after their last cycle.
        assert len(found.values[Point("age", 1, RATE_HZ, who, "ms")]) >= 2 * CYCLES - 2
        assert (found.steady[who].missing, found.steady[who].false_deaths) == (0, 0)
    (sealed,), (bare,) = (
        found.values[Point("on the wire", 1, RATE_HZ, who, "kB/s")] for who in (TLS, "UDP")
    )
    # Requests for addresses come on top.
    assert bare * 1e3 == pytest.approx(RATE_HZ * UDP_BYTES, rel=0.05)
    assert sealed > bare
    seen = {
        what: found.values[Point(what, 1, 0.0, TLS, "ms")]
        for what in ("cable pulled", "plugged in", "killed")
    }
    assert all(len(times) == 1 for times in seen.values())
    # The process is gone at once, and its connection with it; a cable is missed when the lease is
    # over.
    assert seen["killed"] < (LEASE_MS,)
    (nobody,) = (one for one in found.absent if one.who.startswith("nobody"))
    assert nobody.line.startswith(
        "absent: nobody with 1 racks: nobody, machine 0: ended: KeyError: 'nobody'"
    )
    assert not list(NAMESPACES.glob(f"{Lab(1)._hub.rsplit('-', 2)[0]}-*"))


@pytest.mark.slow
@needs_lab
@pytest.mark.skipif(find_spec("cyclonedds") is None, reason="needs cyclonedds")
def test_a_dds_answers_orders_and_what_it_does_not_answer_is_missing() -> None:
    with Lab(2) as lab, Group(lab, "cyclonedds", echoes=True, priority=0) as group:
        found = group.run(RATE_HZ, CYCLES)[COORDINATOR]
    assert 0 < len(found.us) == CYCLES - found.missing


@pytest.mark.slow
def test_figures_show_ratios_deaths_that_were_none_and_a_picture(tmp_path: Path) -> None:
    values = {
        Point("round trip", racks, 10.0, who, "us"): (base * racks, 3 * base * racks)
        for racks in (1, 2)
        for who, base in ((TLS, 600.0), ("UDP", 200.0))
    } | {Point("killed", 1, 0.0, TLS, "ms"): (4.0,)}
    steady = {TLS: Steadiness(rack_s=12.0, taken=40, missing=1, false_deaths=2)}
    found = LanFigures(values, steady, 0.01, True, (Absent("cyclonedds", "no module"),))
    lines = "\n".join(found.lines())
    assert "1 % of packets lost at every rack" in lines
    assert (
        f"{TLS}, undisturbed: 12 s of racks, 40 messages taken, 1 missing, 2 false deaths" in lines
    )
    assert "absent: cyclonedds: no module" in lines
    document = found.document()
    (sample,) = (
        one
        for one in document["samples"]
        if (one["case"], one["who"]) == ("round trip, 2 racks, 10 Hz", TLS)
    )
    assert (sample["median"], sample["ratio"]) == (2400.0, 3.0)
    assert document["undisturbed"][TLS]["false_deaths"] == 2
    assert all(path.stat().st_size for path in found.plot(tmp_path))


def test_without_a_lab_the_bench_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Lab, "is_possible", staticmethod(lambda: "network namespaces need root"))
    done = rack("bench", "lan", "--racks", "1")
    assert (done.returncode, done.stderr) == (1, "network lab: network namespaces need root\n")
