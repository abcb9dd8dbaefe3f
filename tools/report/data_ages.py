"""The ages of the messages that the boards of a run took, from their exchange records."""

from __future__ import annotations

from rack.boards.exchange import AGE_SUFFIX, EXCHANGE_PORT
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
        # Ages and arrivals alternate.
        for age, taken in zip(box.fields[::2], box.fields[1::2], strict=True):
            is_new = recording.read_signal(box.name, taken.name) == ticks
            ages = recording.read_signal(box.name, age.name)[is_new] * recording.layout.clock_ns
            if ages_ms := compute_distribution(ages * 1e-6):
                inputs.append(
                    {
                        "entry": f"{board}.{age.name.removesuffix(f'_{AGE_SUFFIX}')}",
                        "taken": len(ages),
                        "jitter": ages_ms["max"] - ages_ms["min"],
                        "age_ms": ages_ms,
                    }
                )
    return inputs
