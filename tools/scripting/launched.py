"""A rack that a Python program launches, and can record."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import tomli_w

from rack.boards import Rack as CrateRack
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.errors import ConfigError, Mistake
from rack.boards.events import Event
from rack.tools.launch.folder import EventLog, choose_run_folder
from rack.tools.launch.launch import NO_RECORDER, build_result, compare_recording, create_run_folder
from rack.tools.monitor.display import Display
from rack.tools.monitor.holds import StandstillDetector
from rack.tools.recording.recorder.process import RecorderProcess


class LaunchedRack(CrateRack):
    """A rack launched by a program. Use it as a context: the rack ends with the block.

    ```python
    with Rack("nasrem", lockstep=True, settings={"clock.speed": 2}, out="run") as nasrem:
        print(nasrem.run(seconds=10))
    ```
    """

    def __init__(
        self,
        config: str | Path | RackConfig,
        *,
        lockstep: bool = False,
        settings: Mapping[str, Any] = MappingProxyType({}),
        faults: str | Path | None = None,
        out: str | Path | None = None,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        """Read the config. Entering the context, or `launch`, starts its boards.

        Args:
            config: A config by name or path, or a loaded one.
            lockstep: Start a tick only when every due task has finished: exact and repeatable.
            settings: Values that replace the config's, under dotted or nested keys:
                {"clock.speed": 2} or {"clock": {"speed": 2}}. A key that contains a dot is quoted,
                as in TOML.
            faults: A fault script by name or path.
            out: New or empty folder into which the run is recorded, as `rack run` does. None to
                record nothing.
            on_event: Called with every event when it happens.

        Raises:
            ConfigError: The config, a setting or a fault has mistakes, which are all listed.
            Failure: `out` is not empty.
        """
        overrides = [*list_settings(settings), *["clock.mode=lockstep"] * lockstep]
        if not isinstance(config, RackConfig):
            config = load(config, overrides, faults)
        elif overrides or faults is not None:
            raise TypeError("a loaded config takes no settings and no faults")
        super().__init__(config, self._handle_event)
        self.folder = None if out is None else choose_run_folder(Path(out), config.name)
        self._on_event = on_event
        self._log = EventLog(Display())
        self._recorder: RecorderProcess | None = None
        self._standstill: StandstillDetector | None = None
        self._began_s = 0.0

    def __repr__(self) -> str:
        end = "not over" if self.outcome is None else self.outcome.cause
        where = "not recorded" if self.folder is None else f"recorded into {self.folder}"
        return f"<rack '{self.config.name}': {end}, {where}>"

    def _handle_event(self, event: Event) -> None:
        """Log an event, and pass it to the program's handler."""
        if self.folder is not None:
            self._log.add_event(event)
        if self._on_event is not None:
            self._on_event(event)

    def launch(self) -> None:
        """Start all boards except the clock, wait for their self-tests, and begin to record.

        Raises the errors of `rack.boards.Rack.launch`, and `Failure` if `out` cannot be written.
        """
        if self.folder is None:
            super().launch()
            return
        # The recorder imports its libraries while the boards start.
        recorder = self._recorder = RecorderProcess(self.folder)
        super().launch()
        try:
            create_run_folder(self.folder, self.config, self._log)
            if not recorder.attach(self.config.name, None, self.segment.words):
                self._log_text(NO_RECORDER)
            self._standstill = StandstillDetector(self.segment)
            self._began_s = time.monotonic()
        except BaseException:
            self.close()
            raise

    def watch(self, timeout_s: float) -> bool:
        """Supervise the boards for `timeout_s`, or until the run is over.

        Returns:
            False if the run is over.

        Raises:
            Failure: The recording cannot be written.
        """
        is_running = super().watch(timeout_s)
        if self._recorder is not None and self._standstill is not None:
            for text in self._recorder.read_notices():
                self._log_text(text)
            for event in self._standstill.list_events():
                self._log.add_event(event)
        return is_running

    def close(self) -> None:
        """End all processes of the rack, remove its segment, and finish the recording."""
        recorder, folder = self._recorder, self.folder
        if recorder is not None and self.outcome is not None:
            # Wait until the recorder is attached, because it cannot attach to a closed rack.
            recorder.wait_until_attached()
        super().close()
        self._recorder = None
        if recorder is not None and folder is not None:
            wall_s = time.monotonic() - self._began_s
            with closing(self._log):
                why = recorder.finish()
                if (outcome := self.outcome) is not None:
                    comparison = compare_recording(folder, self.segment, why, outcome.ticks)
                    result = build_result(self.segment, self.config, outcome, wall_s, *comparison)
                    self._log.write_outcome(asdict(result))

    def _log_text(self, text: str) -> None:
        """Log a message of the recorder as an event."""
        self._log.add_event(Event(time.time_ns(), -1, "recorder", "", text))


Rack = LaunchedRack
"""The name of the class in the package `rack`."""


def list_settings(tables: Mapping[str, Any], outer: str = "") -> Iterator[str]:
    """Convert tables of Python values to settings, in the form that --set takes.

    Args:
        tables: Dictionary from key to value. Keys may be dotted, and values may be tables.
        outer: Dotted prefix of all keys.

    Raises:
        ConfigError: TOML cannot express a value.
    """
    for key, value in tables.items():
        if isinstance(value, Mapping) and value:
            yield from list_settings(value, f"{outer}{key}.")
        else:
            try:
                yield f"{outer}{key}={_format_inline(value)}"
            except TypeError as error:
                raise ConfigError([Mistake("settings", f"{outer}{key}", str(error))]) from None


def _format_inline(value: Any) -> str:
    """Format a Python value as TOML on one line. Arrays become lists, paths become strings."""
    if isinstance(value, Mapping):
        items = (
            f"{_format_inline(str(key))} = {_format_inline(item)}" for key, item in value.items()
        )
        return f"{{{', '.join(items)}}}"
    if isinstance(value, np.ndarray | list | tuple):
        return f"[{', '.join(map(_format_inline, value))}]"
    plain = str(value) if isinstance(value, Path) else value
    plain = plain.item() if isinstance(plain, np.generic) else plain
    return tomli_w.dumps({"value": plain}).partition("=")[2].strip()
