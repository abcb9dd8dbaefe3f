"""Noise in a rack's shared memory: whoever looks at it says so in one line, and nothing is left."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rack.backplane.address_map import (
    ALARM_DEPTH,
    ALARM_RECORD_SIZE,
    ALARM_SIZE,
    BLOCK_SIZE,
    CACHE_LINE,
    FAULT_ENTRY_SIZE,
    MAILBOX_HEAD_SIZE,
    compute_operator_entry_size,
)
from rack.backplane.errors import BackplaneError
from rack.backplane.mailbox.history import compute_digest
from rack.backplane.segment import Segment, list_racks
from rack.backplane.trace import open_trace_ring
from rack.boards import Rack
from rack.boards.config import read_stored
from rack.boards.crate.alarm_events import AlarmReader
from rack.boards.crate.heartbeat import Heartbeat
from rack.boards.crate.patience import PeerWaitReporter
from rack.boards.events import Ending, Journal
from rack.tools.faults.campaigns.trial import format_levels
from rack.tools.faults.ending import list_strikes, read_arm
from rack.tools.faults.live import LiveRack
from rack.tools.monitor.desk import LevelCommander
from rack.tools.monitor.snapshot import RackMonitor
from rack.tools.recording.spool import open_rings
from tests.boards.commanded_racks import COMMANDED, commands
from tests.boards.config.mistakes import read_config
from tests.boards.conftest import MakeSegment
from tests.processes import RACK, named, start_rack, wait_until
from tests.tools.command_line import BOUND_S

pytestmark = pytest.mark.slow
SEEDS = 6
ALARM_NUMBERS = 8 * 6
"""Bytes of an alarm before its text."""
NOISE = 8 * 32
"""Address behind the head, whose words are checked when a program attaches."""


REGIONS = (
    "words",
    "fault table",
    "operator table",
    "alarms",
    "newest alarms",
    "clock's alarms",
    "count of alarms",
    "control block",
    "trace",
    "mailbox",
    "messages",
    "all",
)
REFUSED = {*REGIONS} - {"trace", "messages", "alarms", "all"}
"""Regions in which some noise is refused. A record of a trace may hold any number, and a damaged
message counts as lost. Noise in all alarms, or anywhere, hits mostly unused memory."""


def first_of(alarms: int) -> int:
    """Return the address of the first record that a ring of alarms gets."""
    return alarms + CACHE_LINE + ALARM_RECORD_SIZE


def regions(segment: Segment) -> dict[str, tuple[int, int]]:
    """Return the parts of a segment that hold numbers, from address to address."""
    places = segment.map
    task = segment.layout.tasks[0].name
    box = segment.layout.mailboxes[0].name
    alarms, clock_alarms = places.alarms[task], places.alarms["clock"]
    found = (
        (NOISE, 8 * 96),
        (places.faults, places.faults + 2 * FAULT_ENTRY_SIZE),
        (places.operator, places.operator + 2 * compute_operator_entry_size(segment.layout)),
        (alarms, alarms + ALARM_SIZE),
        (first_of(alarms), first_of(alarms) + ALARM_NUMBERS),
        (first_of(clock_alarms), first_of(clock_alarms) + ALARM_NUMBERS),
        (alarms, alarms + CACHE_LINE),
        (places.blocks[task], places.blocks[task] + BLOCK_SIZE),
        (places.traces[task], alarms),
        (places.mailboxes[box], places.mailboxes[box] + MAILBOX_HEAD_SIZE),
        (places.mailboxes[box] + MAILBOX_HEAD_SIZE, places.mailboxes[box] + 4096),
        (NOISE, places.size),
    )
    return dict(zip(REGIONS, found, strict=True))


def spoil(segment: Segment, region: str, seed: int) -> None:
    """Write noise over words of a region: any number, or a small one that may be an index."""
    chance = random.Random(f"{region} {seed}")
    begin, end = regions(segment)[region]
    for _ in range(chance.choice((1, 8, 64))):
        at = chance.randrange(begin // 8, end // 8)
        is_small = chance.random() < 0.5
        segment.words[at] = chance.randint(-9, 300) if is_small else chance.getrandbits(64) - 2**63


def looks(segment: Segment) -> dict[str, Callable[[], object]]:
    """Return the ways in which the launcher, commands and recorders look at a rack."""
    config = read_stored(segment.config)
    joints = config.joints
    ending = Ending(segment, None, 1000, 0)
    one = Segment.attach(segment.rack)
    heartbeat = Heartbeat(segment)
    return {
        "monitor": lambda: RackMonitor(segment).take_snapshot(),
        "alarms": lambda: AlarmReader(segment).read_alarms(),
        "heartbeat": heartbeat.find_hanging,
        "awaited": lambda: PeerWaitReporter(segment, Journal(None)).report_if_due(),
        "digest": lambda: compute_digest(segment, 100),
        "latched": ending.list_latched_faults,
        "levels": lambda: format_levels(segment),
        "arm": lambda: read_arm(segment),
        "strikes": lambda: list_strikes(segment, joints),
        "faults": lambda: LiveRack(segment).list_faults(),
        "desk": lambda: list(LevelCommander(one).format_levels()),
        "rings": lambda: [ring.read_new_rows() for ring in open_rings(segment).values()],
        "trace": lambda: open_trace_ring(segment, segment.layout.tasks[0].name).read_new_rows(),
    }


@pytest.fixture(scope="module")
def ran() -> tuple[bytes, Segment]:
    """The memory of a rack after a run with commands, faults and alarms, and its segment."""
    told = commands('level = "upper", what = "hold", tick = 50', 'level = "lower", what = "hold"')
    fault = 'fault=[{ kind = "drop", board = "lower", tick = 60, cycles = 20 }]'
    with Rack(read_config(COMMANDED, [f"name=test-noise-{os.getpid()}", told, fault])) as one:
        one.run(0.3)
        memory = bytes(one.segment.bytes)
        segment = one.segment
    assert {event.kind for event in one.events} >= {"fault", "detection", "command"}
    return memory, segment


@pytest.fixture
def copy(ran: tuple[bytes, Segment], rack_name: str, make_segment: MakeSegment) -> Segment:
    """A segment like that of the rack."""
    _, found = ran
    return make_segment(replace(found.layout, rack=rack_name), found.config, found.published)


@pytest.mark.parametrize("region", REGIONS)
def test_every_tool_refuses_or_reads_a_damaged_rack(
    region: str, ran: tuple[bytes, Segment], copy: Segment
) -> None:
    memory, _ = ran
    refused = 0
    end = copy.map.size
    for seed in range(SEEDS):
        for name in looks(copy):
            copy.bytes[NOISE:end] = memory[NOISE:end]
            look = looks(copy)[name]
            spoil(copy, region, seed)
            try:
                look()
            except BackplaneError:
                refused += 1
            except Exception as error:
                pytest.fail(f"{name}, seed {seed}: {error!r}")
    assert refused or region not in REFUSED


@pytest.mark.thorough
def test_a_launcher_that_reads_no_valid_alarm_ends_in_one_line_and_leaves_nothing(
    tmp_path: Path, rack_name: str
) -> None:
    path, log = tmp_path / "rack.toml", tmp_path / "log"
    path.write_text(COMMANDED)
    command = [*RACK, "run", str(path), "--no-record", "--set", f"name={rack_name}"]
    process = start_rack(command, rack_name, log)
    try:
        segment = Segment.attach(rack_name)
        address = segment.map.alarms["lower"]
        count = segment.words[address // 8] + 1
        record = address + CACHE_LINE + count % ALARM_DEPTH * ALARM_RECORD_SIZE
        segment.words[record // 8 + 2] = 4711
        segment.words[address // 8] = count
        segment.close()
        assert process.wait(BOUND_S) == 1
    finally:
        process.kill()
        process.wait()
    # On a busy machine further lines of progress come before it.
    said = [line for line in log.read_text().splitlines() if not line.startswith(rack_name)]
    assert said == ["the rack's shared memory is damaged: 4711 is not a value of Alarm"]
    assert rack_name not in list_racks()
    wait_until(lambda: not named(f"{rack_name}:"))
