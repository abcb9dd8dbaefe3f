"""A recorded run at a tick, for a Python program: what was in force, the levels, and a rack that
goes on from there."""

from __future__ import annotations

import time
from typing import Any

from rack.backplane.message import AnyMessage
from rack.backplane.words import Run, System
from rack.boards import Rack
from rack.boards.crate.line import CrateLine
from rack.boards.crate.rack import LAUNCH_S
from rack.tools.console.answer import Document, Failure, as_failure
from rack.tools.live.continued import KeptStates, branched, state_at
from rack.tools.recording.in_force import InForce
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, mailbox_of

LOOK_S = 0.005
"""Time between looks for the clock of a rack that is launched: it posts nothing."""


class RecordedMoment:
    """A run before the tasks released at `tick` begin.

    Whatever goes wrong is a `Failure`. Levels and racks go on from the checkpoint
    before; all else is recorded.
    """

    def __init__(self, recording: Recording, in_force: InForce, tick: int) -> None:
        self.tick = tick
        self._recording = recording
        self._in_force = in_force

    @property
    def time_s(self) -> float:
        """Its simulated time, s."""
        return round(self.tick * self._recording.layout.clock_ns * 1e-9, 9)

    def read(self, mailbox: str) -> AnyMessage:
        """Return the message that is in force, as a reader released now finds it."""
        content = self.row(mailbox_of(mailbox, self._recording.layout.timed).name)["message"]
        return AnyMessage(content.dtype, memoryview(bytearray(content.tobytes())))

    def row(self, mailbox: str) -> Any:
        """Return the same with its head, as a row of the mailbox's ring. Raises `Failure`."""
        row = self._in_force.row(mailbox, self.tick)
        if row is None:
            raise Failure(f"{mailbox}: no message yet at {self.time_s:g} s", 2)
        return row

    def __getitem__(self, name: str) -> Any:
        """Return the value of a signal, as in `servo.status.position`: an array or a number; a
        state by its name."""
        signal = Signal.of(name, self._recording.layout.timed)
        return signal.in_message(self.read(signal.mailbox).record)

    @property
    def mailboxes(self) -> dict[str, AnyMessage]:
        """The messages in force, by mailbox."""
        found = (box.name for box in self._recording.layout.timed)
        return {
            name: self.read(name)
            for name in found
            if self._in_force.row(name, self.tick) is not None
        }

    def levels(
        self, crate: CrateLine | None = None, states: KeptStates | None = None
    ) -> dict[str, Document]:
        """Return the attributes of the levels' own objects, by task, in plain data. A `crate` that
        was started earlier saves time, as do `states` found before."""
        run = self._recording
        with (
            as_failure(),
            state_at(run, self.tick, shows=True, crate=crate, states=states) as state,
        ):
            return dict(state.attributes)

    def resume(
        self, *settings: str, faults: str | None = None, seconds: float | None = None
    ) -> Rack:
        """Return a rack in the background that goes on from here in lockstep; with `settings`, as
        in "board.servo.params.bandwidth=80", or `faults` it is a branch.

        Close it, or use it as a context. `seconds` counts from the beginning of the recorded run.
        """
        with as_failure():
            config = branched(self._recording, settings, faults)
            with state_at(self._recording, self.tick) as state:
                begins = state.begins
                rack = Rack(
                    config,
                    entries=begins.entries,
                    keeping=begins.checkpoint,
                    requests=begins.requests,
                )
                rack.launch()
                rack.run_in_background(seconds)
                _await_begun(rack)
        return rack


def _await_begun(rack: Rack) -> None:
    """Wait until the clock, the last of a rack's processes to do so, has read the state."""
    deadline = time.monotonic() + LAUNCH_S
    while rack.segment.words[System.STATE] == Run.STARTING and rack.wait(LOOK_S) is None:
        if time.monotonic() > deadline:
            rack.close()
            raise Failure(f"rack '{rack.config.name}': its clock has not begun in {LAUNCH_S:g} s")
