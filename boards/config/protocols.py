"""The table `[protocol]`: protocols of the mailboxes."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rack.backplane.layout import Protocol, Sampled
from rack.levels.tables import MailboxName, Table

Microseconds = Annotated[float, Field(ge=0, le=1e6, allow_inf_nan=False)]
UNREAD = 32
"""Default for the largest number of unread messages in a queue."""
MOST_UNREAD = 4096
"""Upper limit for the largest number of unread messages in a queue."""


class InterruptConfig(Table):
    """`[protocol.interrupt]`: cost of the messages that interrupt their readers."""

    fixed_us: Microseconds = 50.0
    """time of the interrupt handler for an empty message [us]"""
    word_us: Microseconds = 1.0
    """additional time of the handler for each word of 4 bytes [us]"""
    depth: int = Field(16, ge=1, le=MOST_UNREAD)
    """largest number of pending interrupts at one board; further ones are lost"""


class ProtocolConfig(Table):
    """`[protocol]`: when messages become visible to their readers."""

    default: Sampled = "time-slice"
    """protocol of every mailbox not listed under mailbox"""
    mailbox: dict[MailboxName, Protocol] = {}
    """protocol by mailbox; queue: its only reader gets every message, in order; interrupt: every
    message interrupts the boards that read it"""
    interrupt: InterruptConfig = InterruptConfig()
    """cost of messages under the protocol interrupt"""
    strict: bool = False
    """refuse everything that makes a run depend on timing"""
    depth: dict[MailboxName, Annotated[int, Field(ge=1, le=MOST_UNREAD)]] = Field(
        {}, description=f"largest number of unread messages, by queue; default: {UNREAD}"
    )
