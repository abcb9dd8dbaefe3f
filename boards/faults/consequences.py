"""What each kind of fault leads to: other alarms, reactions that must come, and how soon all is as it was.

An alarm that neither a kind's `seen_as` nor this table explains is a false one.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil
from typing import NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout
from rack.backplane.watch.alarms import Alarm
from rack.boards.faults.bounds import cycle_ticks

SENSOR_ALARMS = (Alarm.SENSOR_RANGE, Alarm.SENSOR_STUCK, Alarm.SENSOR_SILENT, Alarm.SENSOR_MODEL)
UNDONE_S = 0.25
"""Simulated time after a fault in which a reaction is undone, where a kind does not say otherwise."""


class Consequence(NamedTuple):
    """What follows a fault of one kind, besides the alarms that are its detection.

    `own`: alarms about the fault's own task, mailboxes or joint. `arm`: alarms about any joint. `reactions`: codes of
    events, all of which must come. `undone_s`: simulated time from the end of the fault, or its detection, in which
    every reaction must be undone. `ends_process`: it ends the process of its task, and a restart comes on top of that.
    `latches`: instead of being undone it may end the task with an error.
    """

    own: tuple[Alarm, ...] = ()
    arm: tuple[Alarm, ...] = ()
    reactions: tuple[str, ...] = ()
    undone_s: float = UNDONE_S
    ends_process: bool = False
    latches: bool = False


_BRAKED = ("brakes_closed",)
_DEATH = Consequence(own=(Alarm.STALE, Alarm.MUTE, Alarm.CLOCK_STOPPED), reactions=("restart",), ends_process=True)
_SENSOR = Consequence(arm=SENSOR_ALARMS, reactions=_BRAKED, undone_s=1.0, latches=True)
# A motor is tried again every half second: then brakes open, and close again within 12 cycles if it still fails. What
# one motor lacks is never laid to another: such an alarm is a false one.
_MOTOR = Consequence(reactions=_BRAKED, undone_s=0.6, latches=True)
_COMMAND = Consequence(reactions=_BRAKED)
# What is damaged may be any word of the message's head: its serial, its ticks, its writer.
_DAMAGE = Consequence(own=(Alarm.GAP, Alarm.HELD_BACK, Alarm.DISORDER, Alarm.MASQUERADE, Alarm.MUTE))

CONSEQUENCES: Mapping[str, Consequence] = {
    "kill": _DEATH,
    "hang": _DEATH,
    "lock-held": Consequence(own=(Alarm.STALE, Alarm.MUTE, Alarm.HANG), ends_process=True),
    "clock-stop": Consequence(reactions=("restart",), ends_process=True),
    "drop": Consequence(own=(Alarm.MUTE,)),
    # The first messages on time overtake the last ones held back.
    "delay": Consequence(own=(Alarm.DISORDER,)),
    "reorder": Consequence(own=(Alarm.MUTE,)),
    "corrupt": _DAMAGE,
    "babble": Consequence(own=(Alarm.DISORDER, Alarm.GAP)),
    "masquerade": Consequence(own=(Alarm.DISORDER, Alarm.GAP, Alarm.DAMAGED)),
    **dict.fromkeys(("sensor-nan", "sensor-stuck", "sensor-dropout", "sensor-bias", "sensor-noise"), _SENSOR),
    **dict.fromkeys(("actuator-off", "actuator-saturated"), _MOTOR),
    **dict.fromkeys(("command-nan", "command-limit"), _COMMAND),
}
"""By kind; one that is not here leads to nothing else."""
NOTHING = Consequence()


def consequence(kind: str) -> Consequence:
    """Return what follows a fault of a kind."""
    return CONSEQUENCES.get(kind, NOTHING)


def recovery_ticks(kind: str, board: str, layout: Layout, restart_s: float) -> int:
    """Return the ticks from the end of a fault, or its detection, in which all that it led to must be undone.

    `restart_s`: simulated time that a restart may take. A board is back at its next release, and a planner's executor
    goes on when its first plan is there.
    """
    found = consequence(kind)
    restart_s = restart_s if found.ends_process else 0.0
    cycle = cycle_ticks(layout, board) if found.ends_process and board != CLOCK else 0
    return cycle + ceil((found.undone_s + restart_s) * 1e9 / layout.clock_ns)
