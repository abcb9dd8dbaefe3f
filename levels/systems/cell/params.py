"""Parameters of the levels in `rack.levels.systems.cell`, in `[board.<name>.params]`."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StringConstraints

from rack.levels.tables import Positive, Table
from rack.levels.task.program import TaskParams

Mailbox = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")]
RackName = Annotated[str, StringConstraints(pattern=r"^([a-z0-9][a-z0-9_-]{0,39})?$")]
ArmName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]{0,22}$")]


class OrderedTaskParams(TaskParams):
    """From where a task level takes its orders, and for how long it keeps a promise."""

    coordinator: RackName = Field(
        "",
        description=(
            "rack that gives the orders over the network; empty: a board of this rack gives them"
        ),
    )
    orders: Mailbox = Field("lan.orders", description="mailbox with the orders")
    decision: Positive = Field(
        5.0,
        description=(
            "time between an answer and the order to do it, for which a promised time holds, s"
        ),
    )


class CoordinatorParams(Table):
    """The arms that a coordinator orders about, and how long it waits for them."""

    arms: dict[ArmName, Mailbox] = Field(
        min_length=1,
        description=(
            "mailbox with an arm's report, by the arm's name; its orders are in order_<name>"
        ),
    )
    stalled_s: Positive = Field(
        180.0,
        description=(
            "time without any progress after which the program ends, unless an operator holds it;"
            " longer than an arm's, s"
        ),
    )
    farewell_s: Positive = Field(
        10.0,
        description=(
            "time that the arms have to come to rest and to confirm the end of the program, s"
        ),
    )
