"""What levels read of another rack's mailbox: verdicts, loss and age, whatever the network does to
its messages."""

from __future__ import annotations

import pytest

from rack.backplane.mailbox.mailbox import Verdict
from rack.backplane.mailbox.protocols import open_writer
from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.message import AnyMessage, State
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.watch.silence_watch import ReadingTask
from rack.backplane.watch.watched_reader import open_watched
from rack.boards.config.loader import load_text
from rack.boards.lan.adapter import LanAdapter
from rack.boards.lan.entries import Import
from rack.boards.lan.envelope import Envelope, Sealer, compute_kind
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import out_key
from rack.boards.lan.link import ReceivedMessage
from rack.boards.lan.peers import PeerRack
from rack.boards.lan.status import build_status_class
from rack.boards.run.ports import OutputPort
from tests.boards.lan.conftest import EVERY, LAUNCH, Network

MAX_AGE = 40
NEXT = 202


class Importing:
    """The adapter's import `lan.other`, and a level that reads it."""

    def __init__(self, segment: Segment, goes_on: bool = False) -> None:
        self.segment, self.network = segment, Network()
        self.peer = PeerRack("two", keeps_messages=goes_on, offset_ns=0)
        self.grid = OwnGrid(segment, EVERY)
        config = load_text(segment.config)
        assert config.adapter.lan is not None
        self.table = config.adapter.lan.imports["other"]
        self.spec = segment.layout.find_mailbox("lan.other")
        self.dtype = build_message_dtype(self.spec.fields, self.spec.size)
        self.kind = compute_kind(self.spec.message, self.spec.version, self.dtype)
        self.key, self.sealer = out_key("two", "pulse.status"), Sealer()
        self.status = build_status_class((), ("other",)).zeros({})
        self.task = ReadingTask()
        self.reader = open_watched(segment, "lan.other", AlarmWriter(segment, "echo"), self.task)
        self.open()

    def open(self) -> None:
        """Open the import, as an adapter does when it begins."""
        self.entry = Import(self.segment, "lan.other", self.table, self.peer, self.grid)
        self.entry.open(self.network, self.sealer)  # type: ignore[arg-type]
        self.writer = open_writer(self.segment, "lan.other")
        alarms = AlarmWriter(self.segment, "lan")
        self.port = OutputPort(self.segment, self.writer, alarms, (), False)

    def restart(self, tick: int) -> None:
        """Kill the adapter, and begin another one with what the first wrote."""
        self.writer.close()
        self.network.come.clear()
        self.open()
        self.entry.restore_counts(self.status.import_other, tick)

    def send(
        self,
        number: int,
        written: int,
        count: int | None = None,
        launch: int = LAUNCH,
        state: int = State.IDLE,
        **head: int,
    ) -> None:
        """Let a message arrive, written there at the time of our tick `written`."""
        message = AnyMessage(self.dtype)
        message.count = number if count is None else count
        message.record["state"] = state
        time_ns = self.grid.time_ns(written)
        envelope = Envelope(self.kind, launch, number, number, written, time_ns, time_ns)
        payload = bytes(message.raw)
        seal = self.sealer.seal(self.key, envelope._replace(**head), payload)
        self.network.come.append(ReceivedMessage(self.key, seal, payload))

    def come(self, launch: int, tick: int) -> None:
        """Let the other rack come, with a known clock."""
        self.peer.add_token(launch, tick)
        self.peer.offset_ns = 0

    def deliver(self, tick: int, number: int, written: int, **more: int) -> None:
        """Let a message arrive, and do a cycle."""
        self.send(number, written, **more)
        self.cycle(tick)

    def cycle(self, tick: int) -> None:
        self.entry.update_presence(tick)
        self.entry.deliver_newest(self.port.value, tick)
        self.port.write(tick, None)
        self.entry.write_counts(self.status.import_other, tick)

    def read(self, tick: int) -> tuple[Verdict, int, bool]:
        """Return verdict, count and loss, as a level reads them at `tick`."""
        self.task.record_read(tick)
        reading = self.reader.read(tick)
        return reading.verdict, reading.message.count, reading.is_lost

    def counts(self) -> dict[str, int]:
        record = self.entry.count.record
        counted = record.dtype.names[: record.dtype.names.index("launch")]
        return {name: int(record[name]) for name in counted if record[name]}


@pytest.fixture
def importing(segment: Segment) -> Importing:
    found = Importing(segment)
    found.come(LAUNCH, 0)
    return found


NONE, OLD, NEW = Verdict.NONE, Verdict.OLD, Verdict.NEW


def test_a_message_is_new_once_then_old_then_lost_by_its_age(importing: Importing) -> None:
    assert importing.read(0) == (NONE, 0, False)
    importing.deliver(8, 1, written=2, count=77)
    # By ticks: visible at the end of the adapter's cycle.
    assert importing.read(15) == (NONE, 0, False)
    assert importing.read(16) == (NEW, 77, False)
    assert importing.read(17) == (OLD, 77, False)
    assert importing.read(2 + MAX_AGE) == (OLD, 77, False)
    assert importing.read(3 + MAX_AGE) == (OLD, 77, True)
    importing.cycle(56)
    assert importing.entry.is_old(56)
    status = importing.status.import_other
    assert (status["age"], status["age_s"]) == (54, 54 * 0.0025)
    importing.deliver(64, 2, written=60)
    assert importing.read(72) == (NEW, 2, False)


def test_a_message_that_arrives_too_old_is_counted_and_not_delivered(importing: Importing) -> None:
    importing.deliver(MAX_AGE, 1, written=0)
    assert importing.counts() == {"taken": 1}
    importing.deliver(MAX_AGE + 8, 2, written=1)
    assert importing.counts() == {"taken": 1, "late": 1}
    assert importing.read(MAX_AGE + 16)[1] == 1


def test_only_the_newest_of_several_messages_is_delivered(importing: Importing) -> None:
    for number in (3, 5, 4, 4, 5):
        importing.send(number, written=number)
    importing.cycle(8)
    assert importing.read(16) == (NEW, 5, False)
    once = dict.fromkeys(("taken", "missing", "disordered", "superseded"), 1)
    assert importing.counts() == {**once, "repeated": 2}
    assert importing.read(17)[0] is OLD


def test_a_message_of_another_mailbox_is_refused(importing: Importing) -> None:
    importing.send(1, written=1, kind=1)
    importing.send(2, written=1, serial=1 << 63)
    importing.send(3, written=1, launch=1 << 63)
    # A member that the enumeration of its type lacks.
    importing.send(3, written=1, state=77)
    importing.send(4, written=1)
    good = importing.network.come[-1]
    importing.network.come += [
        good._replace(payload=good.payload + b"\0"),
        good._replace(key=out_key("two", "pulse.other")),
        good._replace(envelope=None),
    ]
    importing.cycle(8)
    assert importing.counts() == {"refused": 7, "taken": 1}
    assert importing.read(16) == (NEW, 4, False)


def test_the_count_of_missing_messages_saturates(importing: Importing) -> None:
    for number in (1, 1 << 32, (1 << 62) - 1):
        importing.send(number, written=2)
        importing.cycle(8)
    status = importing.status.import_other
    assert (status["taken"], status["missing"]) == (3, (1 << 32) - 1)


def test_a_lost_rack_stays_lost_until_its_next_message(importing: Importing) -> None:
    importing.deliver(8, 1, written=2)
    assert importing.read(16) == (NEW, 1, False)
    importing.peer.remove_token(LAUNCH, 16)
    importing.peer.mark_lost(16)
    importing.cycle(16)
    lost_from = 24 if importing.grid.is_lockstep else 16
    assert importing.read(lost_from - 1)[2] is (lost_from <= 15)
    assert importing.read(lost_from) == (OLD, 1, True)
    importing.come(LAUNCH, 24)
    importing.cycle(24)
    assert importing.read(32) == (OLD, 1, True)
    importing.deliver(32, 2, written=30)
    assert importing.read(39) == (OLD, 1, True)
    assert importing.read(40) == (NEW, 2, False)


@pytest.mark.parametrize("segment", ["realtime"], indirect=True)
def test_with_go_on_levels_keep_the_last_message_however_old(segment: Segment) -> None:
    importing = Importing(segment, goes_on=True)
    importing.come(LAUNCH, 0)
    importing.deliver(8, 1, written=2)
    importing.peer.mark_lost(16)
    importing.cycle(16)
    assert importing.read(24) == (NEW, 1, False)
    assert importing.read(10 * MAX_AGE) == (OLD, 1, False)
    importing.come(NEXT, 10 * MAX_AGE)
    importing.deliver(10 * MAX_AGE + 8, 1, written=10 * MAX_AGE, launch=NEXT, count=5)
    # From here on by its age again.
    assert importing.read(10 * MAX_AGE + 16) == (NEW, 5, False)
    assert importing.read(11 * MAX_AGE + 1) == (OLD, 5, True)


def test_a_restarted_adapter_continues_and_takes_nothing_twice(importing: Importing) -> None:
    for number in (1, 2):
        importing.send(number, written=number)
    importing.cycle(8)
    assert importing.read(16) == (NEW, 2, False)
    importing.restart(8)
    # Somebody has come, so the newest is sent again; one is lost meanwhile.
    importing.deliver(16, 2, written=2)
    assert importing.read(24) == (OLD, 2, False)
    importing.deliver(24, 4, written=4)
    assert importing.read(32) == (NEW, 4, False)
    assert importing.counts() == {"taken": 2, "superseded": 1, "repeated": 1, "missing": 1}
    assert importing.status.import_other["serial"] == 4


def test_an_adapter_restarted_while_a_rack_is_lost_knows_that_it_is(importing: Importing) -> None:
    importing.deliver(8, 1, written=2)
    importing.peer.mark_lost(16)
    importing.cycle(16)
    importing.restart(16)
    importing.come(LAUNCH, 24)
    importing.cycle(24)
    assert importing.read(32) == (NEW, 1, True)
    importing.deliver(32, 2, written=30)
    assert importing.read(40) == (NEW, 2, False)


@pytest.mark.parametrize("segment", ["realtime"], indirect=True)
def test_the_first_message_of_a_restarted_rack_is_known_from_an_old_one(
    importing: Importing,
) -> None:
    peer = importing.peer
    importing.deliver(8, 900, written=2)
    assert importing.read(16) == (NEW, 900, False)
    # Its first message comes before its token.
    importing.deliver(16, 1, written=14, launch=NEXT, count=5)
    assert importing.counts() == {"taken": 1}
    importing.come(NEXT, 24)
    importing.cycle(24)
    assert importing.read(32) == (NEW, 5, False)
    # Of the old launch, whose token has not expired yet, and after it has.
    importing.deliver(32, 901, written=30)
    peer.remove_token(LAUNCH, 40)
    importing.deliver(40, 902, written=38)
    assert importing.read(48) == (OLD, 5, False)
    assert importing.counts() == {"taken": 2, "unknown_launch": 2}


@pytest.mark.parametrize("segment", ["realtime"], indirect=True)
def test_messages_of_a_launch_whose_token_never_comes_are_bounded_and_forgotten(
    importing: Importing,
) -> None:
    for number in range(1, 100):
        importing.send(number, written=4, launch=NEXT)
    importing.cycle(8)
    assert importing.counts() == {"unknown_launch": 98}
    importing.cycle(8 + MAX_AGE + 8)
    assert importing.counts() == {"unknown_launch": 99}
    importing.cycle(8 + MAX_AGE + 16)
    assert importing.counts() == {"unknown_launch": 99}


@pytest.mark.parametrize("segment", ["realtime"], indirect=True)
def test_a_message_whose_age_is_unknown_waits_for_the_clocks(importing: Importing) -> None:
    importing.peer.offset_ns = None
    importing.deliver(8, 1, written=2)
    assert importing.counts() == {}
    importing.peer.offset_ns = 0
    importing.cycle(16)
    assert importing.read(24) == (NEW, 1, False)
    assert importing.status.import_other["age"] == 14


@pytest.mark.parametrize("segment", ["lockstep"], indirect=True)
def test_in_lockstep_nothing_that_differs_between_runs_is_recorded(importing: Importing) -> None:
    importing.deliver(8, 1, written=2)
    assert importing.read(16) == (NEW, 1, False)
    assert importing.status.import_other["launch"] == 0


def test_a_clock_that_is_ahead_makes_nothing_younger_than_now(importing: Importing) -> None:
    importing.deliver(8, 1, written=100_000, stamp_ns=importing.grid.time_ns(100_000))
    assert importing.status.import_other["age"] == 0
    assert importing.read(16) == (NEW, 1, False)


@pytest.mark.parametrize("segment", ["realtime"], indirect=True)
def test_a_message_from_before_the_first_tick_keeps_its_age(importing: Importing) -> None:
    importing.deliver(8, 1, written=-20)
    assert importing.status.import_other["age"] == 28
    importing.deliver(16, 2, written=-MAX_AGE)
    assert importing.counts() == {"taken": 1, "late": 1}


def test_the_status_is_written_before_what_it_counts(segment: Segment) -> None:
    ports = LanAdapter.build_ports(load_text(segment.config).board["lan"].params, {})
    assert next(iter(ports.outputs)) == "status"
    assert segment.layout.find_mailbox("lan.other").max_age == MAX_AGE
