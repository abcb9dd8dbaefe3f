"""The NASREM rack in real time, its whole task, with every equation put to the run."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import numpy as np

from rack.boards.config import load
from rack.levels.timing.trace_times import distribution
from rack.tools.lab.reproduction.experiments.experiment import (
    Document,
    Experiment,
    Workshop,
    need_real_time,
)
from rack.tools.recording.cycles import Cycles
from rack.tools.recording.history import counted, misses, steal
from rack.tools.recording.recording import Recording
from rack.tools.timing.analysis.analysis import Analysis, Pair
from rack.tools.timing.analysis.document import task_document

NAME = "nasrem"
LASTS_S = 34.0
US = 1e-3
MS = 1e-6
PHASES = ("exchange", "read", "process", "write")
"""The stamped parts of an executor's cycle: C, R, X, W."""


def _run(workshop: Workshop) -> Document:
    # It imports matplotlib.
    from rack.tools.timing.analysis.residuals import plot

    need_real_time()
    recording = workshop.run(NAME, workshop.config(NAME), None)
    analysis = Analysis.of(recording)
    analysis = replace(analysis, config=analysis.config.model_copy(update={"name": NAME}))
    stem = workshop.picture("residuals")
    plot(analysis, stem)
    ended = recording.ended
    late, left_out = counted(misses(recording))
    return {
        "outcome": {**ended["outcome"], "worked": ended["worked"], "wall_s": ended["wall_s"]},
        "missed": late,
        "skipped": left_out,
        "steal": steal(recording)["percent"],
        "pairs": _pairs(analysis),
        "breaches": _breaches(analysis),
        "tasks": {
            name: task_document(cycles, analysis.predicted)
            for name, cycles in analysis.cycles.items()
        },
        "phases": {n: _phases(c) for n, c in analysis.cycles.items() if c.task.role == "executor"},
        "loads": {str(core): load for core, load in analysis.loads.items()},
        "response": analysis.response,
        "mailboxes": [_mailbox(recording, name) for name in recording.mailboxes],
        "bus": {
            n: {k: c[k] for k in ("reads", "read_bytes", "writes", "write_bytes")}
            for n, c in ended["tasks"].items()
        },
        "pictures": {
            "residuals": workshop.shown([stem.with_suffix(".png"), stem.with_suffix(".svg")])
        },
    }


NASREM = Experiment(
    NAME,
    "nasrem in real time, its whole task",
    LASTS_S,
    lambda: {"config": load(NAME).text()},
    _run,
)


def _pairs(analysis: Analysis) -> list[Document]:
    """Return every equation on every subject: predicted, measured in the worst cycle, and in
    most."""
    mostly = {_key(pair): pair for pair in analysis.mostly}
    return [
        {
            "equation": pair.equation,
            "subject": pair.subject,
            "predicted": None if pair.predicted is None else pair.predicted.document(),
            "measured": None if pair.measured is None else pair.measured.document(),
            "mostly": not (found := mostly.get(_key(pair))) or not found.fails,
        }
        for pair in analysis.pairs
    ]


def _key(pair: Pair) -> tuple[str, str, str]:
    shown = pair.measured or pair.predicted
    return pair.equation, pair.subject, shown.meaning if shown is not None else ""


def _breaches(analysis: Analysis) -> dict[str, int]:
    """Return how many cycles broke each equation by their own numbers."""
    broken = chain(
        *({one.equation for one in breach.broken} for breach in analysis.judged_breaches)
    )
    found = list(broken)
    return {equation: found.count(equation) for equation in sorted(set(found))}


def _phases(cycles: Cycles) -> Document:
    """Return the parts of an executor's cycle, us."""
    judged = cycles.is_judged
    return {name: distribution(getattr(cycles, f"{name}_ns")[judged] * US) for name in PHASES}


def _mailbox(recording: Recording, name: str) -> Document:
    """Return what passed through a mailbox, next to what the ticks of its writer demand."""
    box = recording.layout.mailbox(name)
    ticks = recording.ended["outcome"]["ticks"]
    return {
        "mailbox": name,
        "writer": box.writer,
        "readers": list(box.readers),
        "message": box.message,
        "protocol": box.protocol,
        "bytes": box.size,
        "every_ms": box.every * recording.layout.clock_ns * MS,
        "due": -(-ticks // box.every),
        "messages": len(np.unique(recording.signal(name, "serial"))),
    }
