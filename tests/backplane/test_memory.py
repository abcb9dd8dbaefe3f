"""Memory of a real-time process: touched before its cycles."""

from __future__ import annotations

import mmap
import resource
from collections.abc import Callable

import pytest

from rack.backplane.memory import touch_memory
from rack.backplane.segment import Segment
from tests.backplane.bus import mailbox
from tests.backplane.conftest import MakeBus
from tests.processes import FORKS, exit_status, fork

pytestmark = pytest.mark.filterwarnings(FORKS)
PAGES = 4096
FEW = 64
"""Pages used by the process itself: its stack, its allocator, the interpreter's code."""
LARGE = 40 << 20
"""Above the largest bound, 32 MiB, to which the C library raises its own thresholds for
mappings."""


def faults(work: Callable[[], object]) -> int:
    """Return the page faults of this process in `work`."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    work()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def use(memory: bytearray | memoryview) -> None:
    for at in range(0, len(memory), mmap.PAGESIZE):
        memory[at] = memory[at]


@pytest.mark.parametrize("touched", [True, False])
def test_a_forked_process_copies_no_page_later_once_it_has_touched_them(touched: bool) -> None:
    shared = bytearray(PAGES * mmap.PAGESIZE)
    use(shared)

    def board() -> bool:
        if touched:
            touch_memory()
        found = faults(lambda: use(shared))
        # Huge pages, where the system uses them, are copied in one piece.
        return found < FEW if touched else found >= PAGES // 512

    assert exit_status(fork(board)) == 0


def test_the_whole_segment_is_mapped_once_touched(make_bus: MakeBus) -> None:
    segment: Segment = make_bus(mailbox(depth=1 << 14))
    pages = len(segment.bytes) // mmap.PAGESIZE

    def board() -> bool:
        mapped = Segment.attach(segment.rack)
        touch_memory()
        return faults(lambda: use(mapped.bytes)) < FEW < pages // 16

    assert exit_status(fork(board)) == 0


def test_memory_given_back_stays_with_the_process() -> None:
    def board() -> bool:
        touch_memory()
        # The C library maps a piece of this size by itself, and gives it back at once, unless it is
        # kept from that.
        use(bytearray(LARGE))
        return faults(lambda: [use(bytearray(LARGE)) for _ in range(10)]) < FEW

    assert exit_status(fork(board)) == 0
