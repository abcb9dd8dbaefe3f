"""Which launch of another rack is there, whatever the order in which tokens come and go."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rack.backplane.watch.alarms import Alarm
from rack.boards.lan.peers import MAX_LAUNCHES, PeerRack, Peers
from rack.levels.peer import PeerPresence, Presence

OLD, NEW = 11, 22


def alarms(peer: PeerRack) -> list[Alarm]:
    """Return the alarms that a rack's coming and going has raised so far."""
    return [finding.alarm for finding in peer.findings]


def test_a_partition_is_not_a_restart() -> None:
    peer = PeerRack("b")
    peer.add_token(OLD, 5)
    peer.remove_token(OLD, 9)
    peer.add_token(OLD, 20)
    assert (peer.launches, peer.losses, peer.since) == (1, 1, 20)
    assert alarms(peer) == [Alarm.PEER_LOST, Alarm.PEER_BACK]
    assert peer.findings[-1].value == 11


def test_a_new_launch_replaces_one_whose_token_has_not_expired() -> None:
    peer = PeerRack("b")
    peer.add_token(OLD, 5)
    peer.add_token(NEW, 9)
    assert (peer.launch, peer.launches, peer.losses) == (NEW, 2, 1)
    assert alarms(peer) == [Alarm.PEER_LOST, Alarm.PEER_RESTARTED]
    peer.remove_token(OLD, 40)
    assert (peer.launch, peer.is_present, peer.losses) == (NEW, True, 1)
    assert OLD in peer.superseded
    assert NEW not in peer.superseded
    # A late token, as over another way through the network.
    peer.add_token(OLD, 41)
    assert (peer.launch, peer.launches) == (NEW, 2)


def taken(changes: list[tuple[str, int, bool]]) -> Iterator[tuple[str, int, bool]]:
    while changes:
        yield changes.pop(0)


def test_a_restarted_adapter_continues_with_the_same_launch() -> None:
    peer = PeerRack("b")
    peer.add_token(OLD, 5)
    message, after = PeerPresence.zeros({}), PeerRack("b")
    peer.write_presence(message, is_lockstep=False)
    after.restore_state(message, 100)
    assert after.presence is Presence.THERE
    assert (after.launch, after.launches, after.since) == (OLD, 1, 5)
    after.add_token(OLD, 50)
    assert after.presence is Presence.THERE
    assert (after.launches, after.losses, alarms(after)) == (1, 0, [])
    assert after.confirm_by < 0


def test_a_rack_that_ended_during_a_restart_is_lost_in_time() -> None:
    peers = Peers(["b"])
    there, message = PeerRack("b"), PeerPresence.zeros({})
    there.add_token(OLD, 5)
    there.write_presence(message, is_lockstep=False)
    peers["b"].restore_state(message, 100)
    assert peers.update_presence(99) == []
    assert peers["b"].is_present
    assert [finding.alarm for finding in peers.update_presence(100)] == [Alarm.PEER_LOST]
    assert peers.lost_racks == ["b"]
    assert peers.update_presence(101) == []


def test_alarms_name_the_rack_by_its_number_and_strangers_are_no_peers() -> None:
    peers = Peers(["a", "b"])
    changes = [("b", OLD, True), ("stranger", 5, True), ("b", OLD, False)]
    peers.set_source(partial(taken, changes), is_lockstep=False)
    assert [(finding.alarm, finding.subject) for finding in peers.update_presence(7)] == [
        (Alarm.PEER_LOST, 1)
    ]
    assert peers.arrivals == 2
    assert [peer.rack for peer in peers] == ["a", "b"]


def test_in_lockstep_the_message_of_a_peer_depends_on_ticks_alone_also_after_a_restart() -> None:
    message = PeerPresence.zeros({})
    written = []
    for launch, restarted_at in ((OLD, 400), (NEW, 160)):
        rows = []
        for tick in range(0, 800, 8):
            if tick in (0, restarted_at):
                peers, coming = Peers(["b"]), [("b", launch, True)]
                peers.set_source(partial(taken, coming), is_lockstep=True)
                if tick:
                    peers["b"].restore_state(message, tick + 80)
            coming += [("b", launch, False)] if tick == 600 else []
            found = peers.update_presence(tick)
            assert [finding.alarm for finding in found] == [Alarm.PEER_LOST] * (tick == 600)
            peers["b"].write_presence(message, is_lockstep=True)
            rows.append(bytes(message.raw))
        assert message.presence == Presence.LOST
        assert (message.since, message.launches, message.losses) == (600, 1, 1)
        written.append(rows)
    assert written[0] == written[1]


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(1, 4), st.booleans()), max_size=40))
def test_a_rack_is_present_exactly_if_a_current_launch_is(steps: list[tuple[int, bool]]) -> None:
    peer, tokens = PeerRack("b"), set[int]()
    for tick, (launch, has_come) in enumerate(steps):
        was_over = [old for old in range(1, 5) if old in peer.superseded]
        (peer.add_token if has_come else peer.remove_token)(launch, tick)
        (tokens.add if has_come else tokens.discard)(launch)
        living = {token for token in tokens if token not in peer.superseded}
        assert peer.is_present == bool(living)
        assert not peer.is_present or peer.launch in living
        # What is over stays over.
        assert all(old in peer.superseded for old in was_over)
        assert peer.launches <= 4
        assert len(peer.tokens) <= MAX_LAUNCHES
    back = sum(alarm in (Alarm.PEER_BACK, Alarm.PEER_RESTARTED) for alarm in alarms(peer))
    assert alarms(peer).count(Alarm.PEER_LOST) == peer.losses
    assert peer.losses - back == (peer.presence is Presence.LOST)


def test_a_flood_of_tokens_is_bounded() -> None:
    peer = PeerRack("b")
    for launch in range(1, 10 * MAX_LAUNCHES):
        peer.add_token(launch, launch)
    assert len(peer.tokens) == MAX_LAUNCHES
