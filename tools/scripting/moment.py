"""A recorded run at a tick, for a Python program: what was in force, the levels, and a rack that
goes on from there.
"""

from __future__ import annotations

from typing import Any

from rack.backplane.message import AnyMessage
from rack.boards import Rack
from rack.tools.console.answer import Document, Failure, as_failure
from rack.tools.launch.continued import RunAgain, branched
from rack.tools.recording.in_force import InForce
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, mailbox_of


class RecordedMoment:
    """A run before the tasks released at `tick` begin.

    Whatever goes wrong is a `Failure`. For levels and racks the run is repeated up to
    here; all else is recorded.
    """

    def __init__(self, recording: Recording, in_force: InForce, tick: int) -> None:
        self.tick = tick
        self._recording = recording
        self._in_force = in_force

    def __repr__(self) -> str:
        return f"<run {self._recording.folder} at {self.time_s:g} s, tick {self.tick}>"

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
        state by its name.
        """
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

    def levels(self, anyway: bool = False) -> dict[str, Document]:
        """Return the attributes of the levels' own objects, by task, in plain data; `anyway`: even
        if the code or the files of the run have changed since.
        """
        with as_failure(), RunAgain(self._recording, anyway=anyway) as again:
            return again.levels(self.tick)

    def resume(
        self,
        *settings: str,
        faults: str | None = None,
        seconds: float | None = None,
        anyway: bool = False,
    ) -> Rack:
        """Return a rack in the background that goes on from here in lockstep; with `settings`, as
        in "board.servo.params.bandwidth=80", or `faults` it is a branch.

        Close it, or use it as a context. `seconds` counts from the beginning of the recorded run;
        `anyway` is as in `levels`.
        """
        with as_failure():
            config = branched(self._recording, settings, faults)
            again = RunAgain(self._recording, anyway=anyway)
            try:
                begins = again.beginning(self.tick)
                rack = Rack(
                    config, crate=again.crate, entries=begins.entries, continues=begins.continues
                )
                rack.launch()
                rack.run_in_background(seconds)
            except BaseException:
                again.crate.end()
                raise
            again.crate.is_last = True
        return rack
