"""The kinds of faults: what each one does, where it strikes, what it takes, who sees it and how soon.

The order is the number of a kind in the fault table. A bound is in cycles of the task concerned unless it says
otherwise; `rack.boards.faults.bounds` works it out in ticks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rack.backplane.watch.alarms import Alarm

Where = Literal["process", "load", "core", "writer", "bus", "lock", "clock", "arm", "start"]
"""Who does it: `process`, `clock`, `bus`: the clock's board, at the beginning of a tick; `load`, `writer`, `lock`: the
task itself; `core`: a process beside it; `arm`: the level that drives the arm; `start`: the board as it starts."""


@dataclass(frozen=True)
class Parameter:
    """A number that a kind takes: its unit, range and meaning. `default` None: it must be given.

    No parameter is called as a key of every fault is: see `rack.boards.faults.config.FaultConfig`.
    """

    name: str
    unit: str
    meaning: str
    default: float | None
    least: float
    most: float
    is_whole: bool = False


@dataclass(frozen=True)
class Kind:
    """One kind of fault.

    `seen_as`: alarms that count as its detection. `bound`: as text. `realtime`: it does not exist in lockstep, where
    time waits for everybody. `once`: it strikes and is over; others last for a time, or until the end of the run.
    `recoverable`: the task goes on when it is over.
    """

    name: str
    where: Where
    means: str
    seen_as: tuple[Alarm, ...]
    bound: str
    parameters: tuple[Parameter, ...] = ()
    realtime: bool = False
    once: bool = False
    recoverable: bool = True
    takes_mailbox: bool = False

    @property
    def takes_phase(self) -> bool:
        """Whether it can strike within a tick; any other begins with a cycle, or is of the ticks themselves."""
        return self.where in ("process", "bus") or self.name == "clock-stop"


def _joint(default: float = 0) -> Parameter:
    return Parameter("joint", "1", "joint concerned, from 0; -1: all", default, -1, 15, is_whole=True)


def _probability(default: float) -> Parameter:
    return Parameter("probability", "1", "of each message to be hit", default, 0.001, 1.0)


KINDS: tuple[Kind, ...] = (
    Kind("kill", "process", "SIGKILL", (Alarm.STALE,), "5 ms at the Rack, 4 cycles at its neighbours", once=True),
    Kind("hang", "process", "SIGSTOP", (Alarm.HANG,), "4 + 1 cycles"),
    Kind(
        "overrun",
        "load",
        "the executor computes longer",
        (Alarm.LATE, Alarm.STARVED),
        "1 cycle",
        (
            Parameter("by", "cycles", "how much longer", 1.5, 0.0, 100.0),
            Parameter("random", "1", "1: uniformly between 0 and that", 0, 0, 1, is_whole=True),
        ),
        realtime=True,
    ),
    Kind(
        "planner-slow",
        "load",
        "the planner computes beyond its d cycles",
        (Alarm.PLAN_LATE,),
        "d + 1 cycles",
        (Parameter("by", "cycles", "how far beyond", 2.0, 0.5, 100.0),),
        realtime=True,
    ),
    Kind(
        "hog",
        "core",
        "another process at higher priority on the board's core",
        (Alarm.STARVED,),
        "4 + 1 cycles",
        realtime=True,
    ),
    Kind(
        "mute",
        "writer",
        "writes are suppressed",
        (Alarm.MUTE,),
        "2 writer + 1 reader cycles",
        takes_mailbox=True,
    ),
    Kind("drop", "writer", "messages are lost", (Alarm.GAP,), "1 read", (_probability(0.3),), takes_mailbox=True),
    Kind(
        "delay",
        "writer",
        "messages are held back",
        # Until the first comes there is none.
        (Alarm.HELD_BACK, Alarm.MUTE),
        "the delay + 1 read",
        (Parameter("by", "cycles", "writer's cycles for which they are held", 2, 1, 50, is_whole=True),),
        takes_mailbox=True,
    ),
    Kind(
        "reorder",
        "writer",
        "two messages change places",
        # The last message held back may find none to change places with.
        (Alarm.DISORDER, Alarm.HELD_BACK),
        "1 read",
        (_probability(0.3),),
        takes_mailbox=True,
    ),
    Kind(
        "corrupt",
        "writer",
        "bits are flipped in the slot",
        (Alarm.DAMAGED,),
        "1 read",
        (_probability(1.0), Parameter("bits", "1", "bits flipped", 3, 1, 64, is_whole=True)),
        takes_mailbox=True,
    ),
    Kind(
        "babble",
        "writer",
        "writes without pause",
        (Alarm.BABBLE,),
        "1 read",
        (Parameter("writes", "1", "writes in one cycle", 32, 3, 1000, is_whole=True),),
        takes_mailbox=True,
    ),
    Kind(
        "masquerade",
        "bus",
        "a second writer",
        (Alarm.MASQUERADE,),
        "1 read",
        once=True,
        takes_mailbox=True,
    ),
    Kind(
        "lock-held",
        "lock",
        "the holder of a lock is stopped or killed",
        (Alarm.LOCKED,),
        "the lock's time-out",
        (Parameter("killed", "1", "1: killed; 0: stopped", 0, 0, 1, is_whole=True),),
        realtime=True,
        takes_mailbox=True,
        once=True,
    ),
    Kind(
        "clock-stop",
        "clock",
        "SIGSTOP of the clock's board",
        (Alarm.CLOCK_STOPPED,),
        "3 ticks",
        realtime=True,
        once=True,
    ),
    Kind(
        "clock-skip",
        "clock",
        "ticks are left out",
        (Alarm.CLOCK_SKIPPED,),
        "1 tick",
        (Parameter("ticks", "ticks", "how many in a row", 1, 1, 20, is_whole=True),),
        once=True,
    ),
    Kind(
        "clock-jitter",
        "clock",
        "ticks are moved",
        (Alarm.CLOCK_LATE,),
        "2 ticks",
        (Parameter("late", "ticks", "largest lateness; the least is 0.6", 0.9, 0.65, 0.95),),
        realtime=True,
    ),
    Kind("sensor-nan", "arm", "a position is not a number", (Alarm.SENSOR_RANGE,), "1 cycle", (_joint(),)),
    Kind(
        "sensor-stuck",
        "arm",
        "position and velocity stay",
        # Torques that move a joint whose velocity stays look like a motor that gives nothing.
        (Alarm.SENSOR_STUCK, Alarm.SENSOR_MODEL, Alarm.ACTUATOR),
        "20 cycles",
        (_joint(),),
    ),
    Kind("sensor-dropout", "arm", "no new samples", (Alarm.SENSOR_SILENT,), "2 cycles"),
    Kind(
        "sensor-bias",
        "arm",
        "an offset on a position",
        (Alarm.SENSOR_MODEL,),
        "by its size",
        (Parameter("size", "rad", "the offset", 0.02, 1e-5, 3.0), _joint()),
    ),
    Kind(
        "sensor-noise",
        "arm",
        "noise on a position",
        (Alarm.SENSOR_MODEL,),
        "by its size",
        (Parameter("size", "rad", "standard deviation", 0.005, 1e-6, 1.0), _joint()),
    ),
    Kind("actuator-off", "arm", "a motor gives nothing", (Alarm.ACTUATOR,), "5 cycles", (_joint(1),)),
    Kind(
        "actuator-saturated",
        "arm",
        "a motor gives no more than a part of its torque",
        (Alarm.ACTUATOR,),
        "12 cycles",
        (Parameter("part", "1", "of its largest torque", 0.1, 0.0, 0.9), _joint(1)),
    ),
    Kind("command-nan", "arm", "a torque is not a number", (Alarm.COMMAND_INVALID,), "0 cycles", (_joint(),)),
    Kind(
        "command-limit",
        "arm",
        "a torque far beyond its limit",
        (Alarm.COMMAND_LIMIT,),
        "0 cycles",
        (Parameter("factor", "1", "times the limit", 5.0, 1.1, 1e6), _joint()),
    ),
    Kind("self-test", "start", "the start-up test fails", (), "the rack does not arm", once=True, recoverable=False),
)
NUMBERS = {kind.name: number for number, kind in enumerate(KINDS)}
