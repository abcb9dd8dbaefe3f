"""Trace rings: one record per cycle, as its task wrote it."""

from __future__ import annotations

from rack.backplane.trace import FIELDS, TraceWriter, open_trace_ring
from tests.backplane.bus import task
from tests.backplane.conftest import MakeBus

DEPTH = 16


def trace(writer: TraceWriter, ticks: range) -> None:
    for tick in ticks:
        writer.write(*(100 * tick + at for at in range(len(FIELDS))))


def test_records_are_read_as_they_were_written_by_a_task_and_its_successor(
    make_bus: MakeBus,
) -> None:
    segment = make_bus(task("writer", depth=DEPTH), task("reader", slot=3))
    ring = open_trace_ring(segment, "writer")
    trace(TraceWriter(segment, "writer"), range(1, 4))
    trace(TraceWriter(segment, "reader"), range(5, 6))
    trace(TraceWriter(segment, "writer"), range(4, 6))
    rows, lost = ring.read_new_rows()
    assert lost == 0
    assert [row.tolist() for row in rows] == [
        tuple(100 * t + at for at in range(len(FIELDS))) for t in range(1, 6)
    ]


def test_a_trace_without_a_reader_continues_and_lost_records_are_counted(make_bus: MakeBus) -> None:
    segment = make_bus(task("writer", depth=DEPTH))
    writer, ring = TraceWriter(segment, "writer"), open_trace_ring(segment, "writer")
    trace(writer, range(100))
    rows, lost = ring.read_new_rows()
    assert (rows["tick"] // 100).tolist() == list(range(100 - len(rows), 100))
    assert len(rows) + lost == 100
