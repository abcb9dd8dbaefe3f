"""The mirror of a segment: equal to it byte for byte where it was fetched, and read by the same
readers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict

import numpy as np
import pytest

from rack.backplane.errors import SegmentError
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.operator_table import OperatorTable, Request, RequestEntry, RequestStage
from rack.backplane.segment import Segment
from rack.backplane.trace import RECORD, TraceWriter, trace_ring
from rack.backplane.watch.alarms import Alarm, AlarmWriter, alarm_ring
from rack.backplane.words import Head, System
from rack.boards import Rack
from rack.boards.config import load
from rack.boards.lan.questions import Code, DeskAnswer, Stretch
from rack.tools.live.snapshot import RackMonitor
from rack.tools.network.mirror import WORDS, Mirror
from tests.boards.commanded_racks import COMMANDED
from tests.processes import FORKS

pytestmark = pytest.mark.filterwarnings(FORKS)
HOLD = "command=[{level='upper', what='hold', tick=101}]"


class Window:
    """Fetches from a segment at hand, as over a network; `before` runs before every answer."""

    def __init__(self, segment: Segment) -> None:
        self.segment, self.bytes = segment, 0
        self.before: Callable[[Sequence[Stretch]], None] = lambda stretches: None

    def __call__(self, stretches: Sequence[Stretch]) -> tuple[list[bytes], DeskAnswer]:
        """Return the content of stretches."""
        self.before(stretches)
        self.bytes += sum(stretch.size for stretch in stretches)
        found = [bytes(self.segment.view(*stretch)) for stretch in stretches]
        return found, DeskAnswer(Code.GRANTED, 0, time.monotonic_ns(), time.time_ns())


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Segment]:
    """The segment of a rack whose run is over, with a command given."""
    path = tmp_path_factory.mktemp("mirror") / "rack.toml"
    path.write_text(COMMANDED)
    with Rack(load(path, [f"name=test-{os.getpid()}-mirror", HOLD])) as rack:
        rack.run(1.0)
        yield rack.segment


def mirrored(window: Window) -> Mirror:
    mirror = Mirror("far/rack", window)
    mirror.refresh()
    return mirror


@pytest.mark.slow
def test_the_mirror_of_everything_equals_the_segment_ring_by_ring(ran: Segment) -> None:
    window = Window(ran)
    mirror = Mirror("far/rack", window)
    for mailbox in mirror.map.mailboxes:
        mirror.follow(mailbox)
    mirror.refresh()
    assert (mirror.layout, mirror.config) == (ran.layout, ran.config)
    for name in ran.map.mailboxes:
        here, there = MailboxRing(mirror, name).drain(), MailboxRing(ran, name).drain()
        assert here.rows.tobytes() == there.rows.tobytes()
        assert here.lost == there.lost
    for task in ran.layout.tasks:
        assert (
            trace_ring(mirror, task.name).drain().rows.tobytes()
            == trace_ring(ran, task.name).drain().rows.tobytes()
        )
    for owner in ran.map.alarms:
        assert (
            alarm_ring(mirror, owner).drain().rows.tobytes()
            == alarm_ring(ran, owner).drain().rows.tobytes()
        )


def test_every_stretch_fetched_is_equal_byte_for_byte(ran: Segment) -> None:
    window, fetched = Window(ran), list[Stretch]()
    window.before = fetched.extend
    mirror = mirrored(window)
    assert sum(stretch.size for stretch in fetched) < len(ran.bytes) // 4
    assert all(mirror.view(*stretch) == ran.view(*stretch) for stretch in fetched)


def test_a_monitor_sees_the_same_in_the_mirror(ran: Segment) -> None:
    mirror = mirrored(Window(ran))
    here, there = asdict(RackMonitor(mirror).look()), asdict(RackMonitor(ran).look())
    assert here == there
    mirror.is_there = False
    assert RackMonitor(mirror).look().run == "gone"


def test_a_second_refresh_fetches_what_is_new_alone(ran: Segment) -> None:
    window = Window(ran)
    mirror = mirrored(window)
    window.bytes = 0
    mirror.refresh()
    assert window.bytes < 16 * 1024
    alarms = AlarmWriter(ran, "upper")
    ring = alarm_ring(mirror, "upper")
    ring.drain()
    alarms.ring(5, Alarm.LATE, 1)
    assert not ring.waiting
    mirror.refresh()
    assert ring.drain().rows["tick"].tolist() == [5]


def test_records_overwritten_while_they_were_fetched_are_lost_not_wrong(ran: Segment) -> None:
    task = ran.layout.tasks[0]
    window, writer = Window(ran), TraceWriter(ran, task.name)
    written = 0

    def write(count: int) -> None:
        nonlocal written
        for _ in range(count):
            written += 1
            writer.write(written, *[0] * (len(RECORD.names or ()) - 1))

    before = trace_ring(ran, task.name).waiting
    write(task.depth)

    def overtake(stretches: Sequence[Stretch]) -> None:
        if any(stretch.address == ran.map.traces[task.name] for stretch in stretches):
            write(10)

    mirror = Mirror("far/rack", window)
    ring = trace_ring(mirror, task.name)
    window.before = overtake
    mirror.refresh()
    rows, lost = ring.drain()
    # Ten were overwritten, and the slot after them may be under way.
    assert rows["tick"].tolist() == list(range(12, task.depth + 1))
    assert lost == before + 11
    window.before = lambda stretches: None
    mirror.refresh()
    assert ring.drain().rows["tick"].tolist() == list(range(task.depth + 1, task.depth + 11))


def test_messages_between_two_refreshes_are_missing_unless_they_are_followed(ran: Segment) -> None:
    mirror = Mirror("far/rack", Window(ran))
    mirror.follow("lower.status")
    mirror.refresh()
    followed, sampled = (
        MailboxRing(mirror, name).drain() for name in ("lower.status", "upper.status")
    )
    assert np.array_equal(followed.rows, MailboxRing(ran, "lower.status").drain().rows)
    assert (
        sampled.rows["serial"].tolist()
        == MailboxRing(ran, "upper.status").drain().rows["serial"].tolist()[-2:]
    )


def test_a_request_is_followed_until_it_is_issued(ran: Segment) -> None:
    mirror = mirrored(Window(ran))
    table = OperatorTable(ran)
    entry = table.add(Request(0, b"x", tick=9000))
    mirror.refresh()
    seen = RequestEntry(mirror, entry.index)
    assert seen.stage is RequestStage.WAITING
    # Nothing but the entry shows this.
    entry.words[0] = RequestStage.FREE
    mirror.refresh()
    assert seen.stage is RequestStage.FREE


@pytest.mark.parametrize("word", [Head.MAGIC, Head.VERSION])
def test_another_version_is_refused_in_one_line(ran: Segment, word: Head) -> None:
    window = Window(ran)

    def forged(stretches: Sequence[Stretch]) -> tuple[list[bytes], DeskAnswer]:
        found, answer = window(stretches)
        words = memoryview(bytearray(found[0])).cast("q")
        words[word] += 1
        return [words.tobytes(), *found[1:]], answer

    with pytest.raises(
        SegmentError, match="rack 'far/rack': another version; this program mirrors"
    ):
        Mirror("far/rack", forged)


@pytest.mark.parametrize(
    ("word", "value"), [(Head.LAYOUT_SIZE, 1 << 40), (Head.LAYOUT_AT, -8), (Head.SIZE, 1 << 40)]
)
def test_a_head_that_lies_is_refused(ran: Segment, word: Head, value: int) -> None:
    window = Window(ran)

    def forged(stretches: Sequence[Stretch]) -> tuple[list[bytes], DeskAnswer]:
        found, answer = window(stretches)
        if stretches[0] == WORDS:
            words = memoryview(bytearray(found[0])).cast("q")
            words[word] = value
            found[0] = words.tobytes()
        return found, answer

    with pytest.raises(SegmentError):
        Mirror("far/rack", forged)


def test_the_wall_clock_of_the_other_machine_is_known(ran: Segment) -> None:
    def elsewhere(stretches: Sequence[Stretch]) -> tuple[list[bytes], DeskAnswer]:
        found, _ = Window(ran)(stretches)
        return found, DeskAnswer(
            Code.GRANTED, 0, time.monotonic_ns() + 5_000_000_000, 7_000_000_000
        )

    mirror = Mirror("far/rack", elsewhere)
    assert mirror.realtime_ns == 7_000_000_000
    assert mirror.words[System.TICK] == ran.words[System.TICK]
