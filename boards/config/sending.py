"""Instants at which interrupts are sent. They follow from the responses of their writers.

A receiver counts with an instant at which a message is in memory: the worst-case response of its
writer. Responses include the handlers that preempt a task, and a handler runs when a message is
sent. The instants are therefore raised, from the budgets on, until each is at least the response
that follows from all of them, or the end of the cycle. Any such instants are kept: as long as all
earlier messages were in memory in time, handlers run and cycles end as computed.
"""

from __future__ import annotations

from rack.backplane.layout import Layout
from rack.boards.config.layout import LayoutBuilder
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import build_rack_timing

NEVER = 1 << 62
"""A response in ns without a bound. The message is then sent at the end of the cycle."""


def settle_sending(config: RackConfig, builder: LayoutBuilder) -> Layout:
    """Return the layout of a config without mistakes, with the instants of sending.

    A board with `budget.send_within_ms` sends at that time, whether or not its response keeps it.

    Args:
        config: The config.
        builder: Builder of its layout.
    """
    fixed = {*builder.sent_ns}
    # The instants are simulated times, which do not depend on the speed.
    clock = config.clock.model_copy(update={"speed": 1.0})
    config = config.model_copy(update={"clock": clock})
    while True:
        layout = builder.build_layout()
        senders = {
            box.writer: box.interrupt.sent_ns
            for box in layout.mailboxes
            if box.interrupt and box.writer not in fixed
        }
        before_ns = dict(builder.sent_ns)
        for task in build_rack_timing(config, layout).responses if senders else ():
            if task.task in senders:
                builder.sent_ns[task.task] = max(senders[task.task], task.response_ns or NEVER)
        if builder.sent_ns == before_ns:
            return layout
