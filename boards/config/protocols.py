"""The table of the mailboxes' protocols."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StringConstraints

from rack.backplane.layout import Protocol, Sampled
from rack.levels.tables import Table

MailboxName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")]
Microseconds = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
UNREAD = 32
MOST_UNREAD = 4096
"""Default and greatest depth of a queue, messages."""


class InterruptConfig(Table):
    """`[protocol.interrupt]`: the cost of messages that interrupt the boards that read them."""

    fixed_us: Microseconds = 50.0
    """time of the interrupt handler for a message of no words [us]"""
    word_us: Microseconds = 1.0
    """its time for every word of 4 bytes [us]"""
    depth: int = Field(16, ge=1, le=MOST_UNREAD)
    """largest number of interrupts that wait at one board; others are lost"""


class ProtocolConfig(Table):
    """`[protocol]`: how mailboxes are shared."""

    default: Sampled = "time-slice"
    """protocol of every mailbox not listed under mailbox"""
    mailbox: dict[MailboxName, Protocol] = {}
    """protocol by mailbox; queue: its one reader gets every message, in order; interrupt: every
    message interrupts the boards that read it"""
    interrupt: InterruptConfig = InterruptConfig()
    """protocol interrupt: its cost"""
    strict: bool = False
    """refuse whatever makes a run depend on timing"""
    depth: dict[MailboxName, Annotated[int, Field(ge=1, le=MOST_UNREAD)]] = Field(
        {}, description=f"largest number of unread messages, by queue; default: {UNREAD}"
    )
