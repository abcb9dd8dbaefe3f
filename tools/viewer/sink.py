"""A recorder's rows as a recording for the viewer: taken as they are drained, written in blocks."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain, count
from pathlib import Path

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.segment import Segment
from rack.backplane.words import Head, System
from rack.boards.config import loads, rack_timing
from rack.tools.viewer.blocks import Block, Part
from rack.tools.viewer.blueprint import blueprint
from rack.tools.viewer.document import write_document
from rack.tools.viewer.events import Events
from rack.tools.viewer.geometry import write_geometry
from rack.tools.viewer.hierarchy import Hierarchy
from rack.tools.viewer.own import Losses
from rack.tools.viewer.parts import parts_of
from rack.tools.viewer.stream import Stream
from rack.tools.viewer.timelines import Timelines
from rack.tools.viewer.timing import Age, CycleLanes, Load, Misses

FILE = "run.rrd"
BLOCK_S = 1.0
"""Simulated time in one block: a call costs the same for 4 rows and for 400."""


def next_file(folder: Path) -> Path:
    """Return the file to write: a recorder that was started again leaves run.rrd alone and writes run-2.rrd."""
    names = chain([FILE], (f"run-{part}.rrd" for part in count(2)))
    return next(folder / name for name in names if not (folder / name).is_file())


class ViewSink:
    """Writes run.rrd of one rack into `folder`; with a port, serves it to a viewer of this machine as well."""

    def __init__(self, segment: Segment, folder: Path, port: int | None) -> None:
        layout, words = segment.layout, segment.words
        config = loads(segment.config)
        cell = None
        if config.robot is not None:
            from rack.levels.robot.cell import build_cell

            cell = build_cell(config.robot, config.scene, config.clock_ns)
        self._times = Timelines(layout.clock_ns)
        view = blueprint(layout, config, cell, live=port is not None)
        run = f"{folder.name}-{words[Head.CREATED_NS]}"
        self._stream = stream = Stream(folder.name, run, next_file(folder), self._times, view, port)
        write_document(stream, segment.config, config, layout)
        if cell is not None:
            write_geometry(stream, cell.model, cell.start())
        self._of_mailbox = parts_of(stream, layout, config, cell)
        lockstep, period_ns = bool(words[System.LOCKSTEP]), words[System.PERIOD_NS]
        speed = 1.0 if lockstep else layout.clock_ns / period_ns
        slice_ns = layout.clock_ns if lockstep else period_ns
        self._of_task: dict[str, list[Part]] = {
            task.name: [
                CycleLanes(stream, task, speed, lockstep),
                Load(stream, task, slice_ns, lockstep),
                Misses(stream, task),
            ]
            for task in layout.tasks
        }
        # An operator's mailbox has no age: commands come now and then.
        periodic = [mailbox for mailbox in layout.mailboxes if mailbox.writer != CLOCK]
        self._ages = {mailbox.name: Age(stream, mailbox, layout) for mailbox in periodic}
        self._hierarchy = Hierarchy(stream, layout, rack_timing(config, layout).hierarchy)
        self._events = Events(stream, folder / "events.jsonl", self._hierarchy)
        self._losses = Losses(stream)
        self._fastest = min(layout.tasks, key=lambda task: task.every).name
        self._cycles: dict[str, list[np.ndarray]] = {name: [] for name in self._of_task}
        self._signals: dict[str, list[np.ndarray]] = {name: [] for name in self._of_mailbox}
        self._block = max(1, round(BLOCK_S * 1e9 / layout.clock_ns))
        self._written = words[System.TICK]

    def add_cycles(self, task: str, rows: np.ndarray) -> None:
        """Take trace records of a task, shape (rows,)."""
        if len(rows):
            self._cycles[task].append(rows)

    def add_signals(self, mailbox: str, rows: np.ndarray) -> None:
        """Take rows of a mailbox's ring, shape (rows,)."""
        if len(rows):
            self._signals[mailbox].append(rows)

    def advance(self, tick: int, lost: Mapping[str, int]) -> None:
        """Write a block when one is full: everything before `tick` has been taken. `lost` counts rows by ring.

        Raises `RuntimeError` when the file cannot be written.
        """
        if tick - self._written >= self._block:
            self._write(tick, lost)
            self._stream.flush()

    def close(self, tick: int, lost: Mapping[str, int]) -> None:
        """Write what waits and finish the file. Raises `RuntimeError` when it cannot be written."""
        self._write(tick, lost)
        self._stream.flush()
        self._stream.close()

    def _write(self, tick: int, lost: Mapping[str, int]) -> None:
        self._written = tick
        cycles, signals = _taken(self._cycles), _taken(self._signals)
        if self._fastest in cycles:
            self._times.learn(cycles[self._fastest]["tick"], cycles[self._fastest]["start_ns"])
        for task, rows in cycles.items():
            block = Block(rows, "start_ns", self._times)
            for part in self._of_task[task]:
                part.write(block)
            self._hierarchy.write(task, block)
        for mailbox, rows in signals.items():
            block = Block(rows, "stamp_ns", self._times)
            for part in self._of_mailbox[mailbox]:
                part.write(block)
            if mailbox in self._ages:
                self._ages[mailbox].write(block)
        for age in self._ages.values():
            age.advance(tick)
        self._events.advance()
        self._hierarchy.advance()
        self._losses.advance(tick, lost)


def _taken(waiting: dict[str, list[np.ndarray]]) -> dict[str, np.ndarray]:
    taken = {name: np.concatenate(blocks) for name, blocks in waiting.items() if blocks}
    for blocks in waiting.values():
        blocks.clear()
    return taken
