"""The ages of the messages that the boards of a run took, from their exchange records."""

from __future__ import annotations

import numpy as np

from rack.boards.exchange import AGE_SUFFIX, EXCHANGE_PORT, TAKEN_SUFFIX
from rack.boards.timing.trace_times import compute_distribution
from rack.tools.console.answer import Document
from rack.tools.recording.recording import Recording


def summarize_data_ages(recording: Recording) -> list[Document]:
    """Return the ages in ms of the messages at each input of the boards with an exchange record.

    An age counts from the release of the writer's cycle to that of the cycle that takes the
    message. `jitter` is the difference of the largest and the smallest age.
    """
    inputs = []
    for box in recording.layout.mailboxes:
        board, _, port = box.name.partition(".")
        if port != EXCHANGE_PORT:
            continue
        ticks = recording.read_signal(box.name, "tick")
        for field in box.fields[::2]:
            label = field.name.removesuffix(f"_{AGE_SUFFIX}")
            taken = recording.read_signal(box.name, f"{label}_{TAKEN_SUFFIX}")
            ages = recording.read_signal(box.name, field.name)[taken == ticks]
            if len(ages):
                ages_ms = ages * (recording.layout.clock_ns * 1e-6)
                inputs.append(
                    {
                        "entry": f"{board}.{label}",
                        "taken": len(ages),
                        "jitter": round(float(np.ptp(ages_ms)), 6),
                        "age_ms": compute_distribution(ages_ms),
                    }
                )
    return inputs
