"""Two racks in real time, on one machine's loopback: boards and racks die and come back, and
nothing is taken twice, or from one who sends in the name of another."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.backplane.errors import BackplaneError, SegmentError
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Demand, System
from rack.boards import Rack
from rack.boards.config.loader import load_text
from rack.boards.crate.clean import remove_dead_rack
from rack.boards.lan.link import MAX_UNREAD
from rack.levels.peer import Presence
from rack.tools.network.certificates import make_credentials
from tests.boards.lan.forger import FORGED, LATER
from tests.boards.lan.racks import (
    LAUNCH_S,
    RackProcess,
    configs,
    endpoints,
    rack_text,
    started,
)
from tests.boards.lan.test_strangers import running
from tests.boards.runs import stop
from tests.machine import needs_fifo
from tests.processes import wait_until

pytestmark = pytest.mark.slow

SECONDS = 120.0
"""Longest run of a rack: the tests end them long before."""
GENTLE = ("adapter.lan.lease_ms=1000",)
"""Longer than any pause of a loaded machine."""


def newest(segment: Segment, mailbox: str) -> Any:
    """Return the newest message of a mailbox."""
    return open_observer(segment, mailbox).peek().message


def attached(name: str) -> Segment:
    """Attach to a rack as soon as it is there."""
    found: list[Segment] = []

    def is_there() -> bool:
        with suppress(SegmentError):
            found.append(Segment.attach(name))
        return bool(found)

    wait_until(is_there, LAUNCH_S)
    return found[0]


def written(segment: Segment, mailbox: str) -> np.ndarray:
    """Return the messages of a mailbox that its slots still hold."""
    return MailboxRing(segment, mailbox).read_new_rows().rows["message"]


def awaited(rack: RackProcess, since: int, kind: str, text: str) -> dict[str, Any]:
    """Return an event of a kind whose text contains this, after the first `since`: clock and
    adapter ring apart."""
    past = [
        event for event in rack.events[since:] if event["kind"] == kind and text in event["text"]
    ]
    return past[0] if past else rack.await_event(kind, text)


def kill_adapter(segment: Segment) -> None:
    """Kill a rack's adapter, and wait until a new one exchanges."""
    block, status = segment.get_block("lan"), open_observer(segment, "lan.status")
    pid = block[Block.PID]
    os.kill(pid, signal.SIGKILL)
    wait_until(lambda: block[Block.PID] != pid and not block[Block.LOST])
    status.peek()
    after = status.serial
    wait_until(lambda: status.peek() and status.serial > after + 2)


@pytest.fixture
def names(rack_name: str) -> Iterator[tuple[str, str]]:
    """Names of two racks, which may be killed."""
    found = f"{rack_name}-a", f"{rack_name}-b"
    yield found
    for name in found:
        remove_dead_rack(name)


@pytest.mark.thorough
@pytest.mark.alone
def test_boards_and_racks_die_and_come_back(names: tuple[str, str], tmp_path: Path) -> None:
    (at,) = endpoints(1)
    texts = [
        rack_text(names[0], at, [], peers=[names[1]]),
        rack_text(names[1], "", [at], names[0], lan='on_peer_loss = "stop"').replace(
            "max_age_ms = 100", "max_age_ms = 9000"
        ),
    ]
    configs(texts, tmp_path)
    files = [tmp_path / f"rack-{at}.toml" for at in range(2)]
    with started(files[1], SECONDS, *GENTLE) as reading:
        b = attached(names[1])
        try:
            with started(files[0], SECONDS, *GENTLE) as writing:
                a = attached(names[0])
                wait_until(lambda: newest(b, "echo.status").count > 0)
                entry = newest(b, "lan.status").import_other.copy()
                assert (entry["missing"], entry["repeated"], entry["unknown_launch"]) == (0, 0, 0)
                assert entry["age"] >= 0

                kill_adapter(b)
                after = newest(b, "lan.status").import_other.copy()
                assert after["taken"] >= entry["taken"]
                assert after["number"] >= entry["number"]
                wait_until(lambda: newest(b, "lan.status").import_other["taken"] > after["taken"])
                # It was away, not the other rack, which saw it go and come.
                peer = newest(b, f"lan.peer_{names[0].replace('-', '_')}")
                assert (peer.presence, peer.launches, peer.losses) == (Presence.THERE, 1, 0)
                peer = newest(a, f"lan.peer_{names[1].replace('-', '_')}")
                assert (peer.presence, peer.launches, peer.losses) == (Presence.THERE, 1, 1)

                kill_adapter(a)
                assert newest(a, "lan.status").export_pulse["sent"] >= after["number"]
                reading.await_event("recovery", f"rack '{names[0]}' is back after")
                taken = newest(b, "lan.status").import_other["taken"]
                wait_until(lambda: newest(b, "lan.status").import_other["taken"] > taken)
                # Whatever died, no message came twice, or after a later one.
                assert (np.diff(written(b, "lan.other")["count"]) > 0).all()
                wait_until(lambda: b.words[System.DEMAND] == Demand.NONE)

                since = len(reading.events)
                writing.send(signal.SIGKILL)
                event = awaited(reading, since, "detection", f"rack '{names[0]}' is lost")
                assert (event["code"], event["subject"]) == ("peer_lost", names[0])
                event = awaited(reading, since, "reaction", "a rack that it works with is lost")
                assert (event["code"], event["value"]) == ("demand", Demand.STOP)
                lost = newest(b, "echo.status").lost
                wait_until(lambda: newest(b, "echo.status").lost > lost + 2)
            with started(files[0], SECONDS, *GENTLE) as writing:
                since = len(reading.events)
                # Its counting begins again: what comes now is of the new launch.
                wait_until(lambda: (np.diff(written(b, "lan.other")["count"]) < 0).any())
                event = awaited(reading, since, "recovery", "it was restarted")
                assert event["subject"] == names[0]
                awaited(reading, since, "recovery", "arm released")
                peer = newest(b, f"lan.peer_{names[0].replace('-', '_')}")
                assert (peer.presence, peer.launches) == (Presence.THERE, 2)
        finally:
            b.close()


@needs_fifo
@pytest.mark.alone
def test_the_threads_of_the_network_have_core_and_priority_of_the_adapter(
    rack_name: str, tmp_path: Path
) -> None:
    (config,) = configs(
        [rack_text(rack_name, endpoints(1)[0], [])],
        tmp_path,
        "adapter.lan.priority=37",
        "board.pulse.priority=36",
    )
    with Rack(config) as rack:
        pid = rack.segment.get_block("lan")[Block.PID]
        core = rack.segment.layout.find_task("lan").core
        threads = [int(path.name) for path in Path(f"/proc/{pid}/task").iterdir()]
        assert len(threads) > 1
        for thread in threads:
            assert os.sched_getscheduler(thread) == os.SCHED_FIFO
            assert os.sched_getparam(thread).sched_priority == 37
            assert os.sched_getaffinity(thread) == {core}


@pytest.mark.alone
def test_a_flood_costs_bounded_work_and_other_entries_continue(
    rack_name: str, tmp_path: Path
) -> None:
    (at,) = endpoints(1)
    calm = """
[adapter.lan.import.calm]
from = "flood/calm.status"
type = "lan_levels:PulseStatus"
rate_hz = 50
max_age_ms = 1000
"""
    (config,) = configs(
        [rack_text(rack_name, at, [], "flood", lan="lease_ms = 1000") + calm], tmp_path
    )
    with Rack(config) as rack, running("flooder", "flood", at, rack_name):
        rack.start(SECONDS)

        def goes_on() -> bool:
            rack.watch(0.01)
            # The clocks are not compared, so the calm messages wait, and the next one overtakes
            # each.
            entry = newest(rack.segment, "lan.status")
            return (
                entry.import_other["refused"] > 20 * MAX_UNREAD
                and entry.import_calm["superseded"] > 10
            )

        wait_until(goes_on)
        rows = written(rack.segment, "lan.status")
        stop(rack)
    refused = np.diff(rows["import_other"]["refused"].astype(int))
    assert refused.max() == MAX_UNREAD
    assert (refused >= 0).all()
    assert rows["import_other"]["taken"][-1] == 0


def test_an_adapter_killed_in_lockstep_continues_its_counts_and_the_run_repeats(
    rack_name: str,
) -> None:
    text = rack_text(rack_name, "", []).replace("[clock]", '[clock]\nmode = "lockstep"')
    text += '[[fault]]\nkind = "kill"\nboard = "lan"\ntick = 100\n'
    ended = []
    for _ in range(2):
        with Rack(load_text(text)) as rack:
            outcome = rack.run(1.5)
            ended.append(
                (outcome.digest, int(newest(rack.segment, "lan.status").export_pulse["sent"]))
            )
            assert [event.board for event in rack.events if event.code == "rejoined"] == ["lan"]
            rows = written(rack.segment, "lan.status")["export_pulse"]["sent"].astype(int)
    assert ended[0] == ended[1]
    # Of the messages written meanwhile only the newest was sent: it sampled fewer, and none twice.
    assert (np.diff(rows) >= 0).all()
    assert 40 < ended[0][1] == rows[-1]


ROUNDS = 20


def taken(rack: str) -> int:
    """Return the messages of the other rack that a rack has taken so far."""
    with suppress(BackplaneError):
        segment = Segment.attach(rack)
        try:
            status = open_observer(segment, "lan.status").peek()
            return int(status.message.import_other["taken"]) if status.has_message else 0
        finally:
            segment.close()
    return 0


@pytest.mark.thorough
def test_a_rack_that_sends_under_another_name_is_refused(rack_name: str, tmp_path: Path) -> None:
    names = [f"{rack_name}-{end}" for end in "ab"]
    for folder in ("certs", "certs/theirs"):
        make_credentials(tmp_path / folder, dict.fromkeys([*names, "forger"], ()), 1)
    # Without TLS: with it a rack does not even hear another one under this name.
    at, own = endpoints(2), 'certificates = "certs"'
    texts = [
        rack_text(names[0], at[0], (), lan=own, peers=names[1:], insecure=False),
        rack_text(names[1], at[1], at[:1], names[0], lan=own, insecure=False),
    ]
    configs(texts, tmp_path)
    with ExitStack() as stack:
        for k in range(2):
            stack.enter_context(started(tmp_path / f"rack-{k}.toml"))
        wait_until(lambda: taken(names[1]) > ROUNDS, LAUNCH_S)
        members = [str(tmp_path / "certs"), "forger", names[0]]
        forger = stack.enter_context(running("forger", *members, *at))
        wait_until(lambda: forger.state()["forged"] > ROUNDS)
        segment = Segment.attach(names[1])
        stack.callback(segment.close)
        status, echo = (open_observer(segment, name) for name in ("lan.status", "echo.status"))

        def imported(count: str) -> int:
            return int(status.peek().message.import_other[count])

        before = taken(names[1])
        wait_until(lambda: taken(names[1]) > before + ROUNDS)
        wait_until(lambda: imported("repeated") > ROUNDS)
        did, heard = forger.state(), echo.peek().message
        wait_until(lambda: int(status.peek().message.flaws["unsigned"]) >= did["forged"])
        assert did["opened"] == did["heard"]
        assert imported("refused") >= did["forged"]
        # A message that was forged and taken would make all up to it missing. Some may be: of 32
        # that wait, the newest stay, and that is 0.1 s of what the forger sends.
        assert imported("missing") < LATER - 1
        assert 0 < heard.count < heard.total < FORGED
        assert heard.backward == 0
