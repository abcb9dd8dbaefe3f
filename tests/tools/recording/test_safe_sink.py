"""A sink that fails or opens slowly: the recorder continues, and the user gets one message."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping

import numpy as np
import pytest

from rack.tools.recording.recorder.recorder import SafeSink

WATCHDOG_S = 60.0


class Taking:
    """A sink that records the calls, and fails at the block after `whole_blocks`."""

    def __init__(self, whole_blocks: float = math.inf) -> None:
        self.calls: list[object] = []
        self.blocks, self.whole_blocks = 0, whole_blocks

    def add(self, ring: str, rows: np.ndarray) -> None:
        """Keep the rows."""
        self.calls.append((ring, rows.tolist()))

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Keep the tick, or fail."""
        self.blocks += 1
        if self.blocks > self.whole_blocks:
            raise RuntimeError("the disk\nis full")
        self.calls.append(tick)

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Keep the end."""
        assert self.blocks <= self.whole_blocks, "a sink that failed is not asked again"
        self.calls.append("end")


def test_a_sink_that_fails_is_reported_once_and_not_called_again() -> None:
    notes: list[str] = []
    sink = Taking(whole_blocks=1)
    safe = SafeSink(lambda: sink, notes.append)
    for tick in range(5):
        safe.add("servo", np.zeros(1))
        safe.advance(tick, {})
    safe.close(5, {})
    assert notes == ["run.rrd ends here: the disk is full"]
    assert sink.blocks == 2

    def opened() -> Taking:
        raise ImportError("no viewer here")

    safe = SafeSink(opened, notes.append)
    safe.add("servo", np.zeros(1))
    safe.close(1, {})
    assert notes[1:] == ["run.rrd ends here: no viewer here"]


class Opening:
    """Opens a sink once the test permits it."""

    def __init__(self) -> None:
        self.may, self.sink = threading.Event(), Taking()

    def __call__(self) -> Taking:
        assert self.may.wait(WATCHDOG_S)
        return self.sink


def test_rows_wait_for_a_sink_that_takes_long_to_open() -> None:
    opening = Opening()
    safe = SafeSink(opening, pytest.fail, in_background=True)
    for tick in range(3):
        safe.add("servo", np.array([tick]))
        safe.advance(tick, {})
    calls = opening.sink.calls
    assert calls == []
    opening.may.set()
    safe.close(3, {})
    assert calls == [("servo", [0]), 0, ("servo", [1]), 1, ("servo", [2]), 2, "end"]


@pytest.mark.parametrize(
    ("bound", "bound_s", "hurries"),
    [
        ("HURRIED_TIMEOUT_S", 0.05, True),
        ("OPENING_TIMEOUT_S", 0.05, False),
        # The recorder does not wait if opening uses no processor time.
        pytest.param("CHECK_PERIOD_S", 0.02, False, marks=pytest.mark.thorough),
    ],
)
def test_a_recorder_does_not_wait_for_ever_for_a_sink_whose_opening_hangs(
    monkeypatch: pytest.MonkeyPatch, bound: str, bound_s: float, hurries: bool
) -> None:
    monkeypatch.setattr(f"rack.tools.recording.recorder.recorder.{bound}", bound_s)
    opening, notes = Opening(), list[str]()
    safe = SafeSink(opening, notes.append, in_background=True)
    safe.add("servo", np.zeros(1))
    if hurries:
        safe.hurry()
    safe.close(1, {})
    assert safe._opening.is_alive()
    opening.may.set()
    assert opening.sink.calls == []
    (note,) = notes
    assert note.startswith("run.rrd is missing: ")
    assert bound != "OPENING_TIMEOUT_S" or note.endswith(
        "the viewer's library has not opened it; 'rack replay' makes it"
    )
