"""A recorded run at one tick, for a Python program."""

from __future__ import annotations

from typing import Any

from rack.backplane.message import AnyMessage
from rack.boards import Rack
from rack.tools.console.answer import Document, Failure, convert_errors
from rack.tools.launch.continued import RepeatedRun, load_branch_config
from rack.tools.recording.in_force import VisibleMessages
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, find_mailbox


class RecordedMoment:
    """State of a recorded run just before the tasks released at `tick` begin.

    Every error is raised as a `Failure`. Messages come from the recording. To read the objects of
    levels, or to continue the rack from this tick, the run is repeated up to it.
    """

    def __init__(self, recording: Recording, in_force: VisibleMessages, tick: int) -> None:
        self.tick = tick
        self._recording = recording
        self._in_force = in_force

    def __repr__(self) -> str:
        return f"<run {self._recording.folder} at {self.time_s:g} s, tick {self.tick}>"

    @property
    def time_s(self) -> float:
        """Simulated time of the tick in s."""
        return round(self.tick * self._recording.layout.clock_ns * 1e-9, 9)

    def read(self, mailbox: str) -> AnyMessage:
        """Return the message that a task released at this tick would read."""
        content = self.row(find_mailbox(mailbox, self._recording.layout.timed).name)["message"]
        return AnyMessage(content.dtype, memoryview(bytearray(content.tobytes())))

    def row(self, mailbox: str) -> Any:
        """Return the message of `read` with its header, as a row of the ring. Raises `Failure`."""
        row = self._in_force.find_row(mailbox, self.tick)
        if row is None:
            raise Failure(f"{mailbox}: no message yet at {self.time_s:g} s", 2)
        return row

    def __getitem__(self, name: str) -> Any:
        """Return the value of a signal, as in `servo.status.position`.

        The value is an array or a number, or the name of a state.
        """
        signal = Signal.parse(name, self._recording.layout.timed)
        return signal.read_message(self.read(signal.mailbox).record)

    @property
    def mailboxes(self) -> dict[str, AnyMessage]:
        """Dictionary from mailbox to the message that a task released at this tick would read."""
        names = (box.name for box in self._recording.layout.timed)
        return {
            name: self.read(name)
            for name in names
            if self._in_force.find_row(name, self.tick) is not None
        }

    def levels(self, anyway: bool = False) -> dict[str, Document]:
        """Return a dictionary from task to the attributes of its level's object, as plain data.

        Args:
            anyway: True to repeat the run even if its code or files have changed since.
        """
        with convert_errors(), RepeatedRun(self._recording, anyway=anyway) as again:
            return again.read_levels(self.tick)

    def resume(
        self,
        *settings: str,
        faults: str | None = None,
        seconds: float | None = None,
        anyway: bool = False,
    ) -> Rack:
        """Continue the run in the background, in lockstep, and return its rack.

        The caller must close the rack, or use it as a context.

        Args:
            settings: Changed values, as in "board.servo.params.bandwidth=80". Any change makes the
                run a branch.
            faults: A fault script by name or path. It also makes the run a branch.
            seconds: Simulated time from the beginning of the recorded run. None to run to the end.
            anyway: True to repeat the run even if its code or files have changed since.
        """
        with convert_errors():
            config = load_branch_config(self._recording, settings, faults)
            again = RepeatedRun(self._recording, anyway=anyway)
            try:
                begins = again.continue_at(self.tick)
                rack = Rack(
                    config, crate=again.crate, entries=begins.entries, continues=begins.continues
                )
                rack.launch()
                rack.run_in_background(seconds)
            except BaseException:
                again.crate.end_crate()
                raise
            again.crate.is_last = True
        return rack
