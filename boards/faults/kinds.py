"""The project's own kinds of faults, one record each, in the order in which `rack inject --list` shows them."""

from __future__ import annotations

from rack.backplane.watch.alarms import Alarm
from rack.boards.faults import bounds, clock_board, messages, tasks
from rack.boards.faults import drawing as draw
from rack.boards.faults.kind import DIED, KINDS, Consequence, Kind, Parameter
from rack.levels import faults as arm

BRAKED = ("brakes_closed",)
DEATH = Consequence(own=(Alarm.STALE, Alarm.MUTE, Alarm.CLOCK_STOPPED), reactions=("restart",), ends_process=True)
SENSOR = Consequence(
    arm=(Alarm.SENSOR_RANGE, Alarm.SENSOR_STUCK, Alarm.SENSOR_SILENT, Alarm.SENSOR_MODEL),
    reactions=BRAKED,
    recovery_s=1.0,
    latches=True,
)
# A motor is tried again every half second: the brakes are released, and engage again within 12 cycles if it still
# fails. An alarm about another motor is a false one.
MOTOR = Consequence(reactions=BRAKED, recovery_s=0.6, latches=True)
COMMAND = Consequence(reactions=BRAKED)
# The damage may be in any word of the message's head: its serial, its ticks, its writer.
DAMAGE = Consequence(own=(Alarm.GAP, Alarm.HELD_BACK, Alarm.DISORDER, Alarm.MASQUERADE, Alarm.MUTE))
BIAS_RAD, NOISE_RAD = 0.02, 0.005
"""Sizes from which a wrong sensor must be found."""


def _joint(drawn: draw.Draw = draw.joint, default: float = 0) -> Parameter:
    return Parameter("joint", "1", "joint concerned, from 0; -1: all", default, -1, 15, is_whole=True, drawn=drawn)


def _probability(default: float, most: float) -> Parameter:
    return Parameter("probability", "1", "of each message to be hit", default, 0.001, 1.0, drawn=draw.number(0.5, most))


def _size(meaning: str, visible: float, least: float, most: float) -> Parameter:
    return Parameter("size", "rad", meaning, visible, least, most, drawn=draw.size_from(visible))


KINDS.add(
    Kind(
        name="kill",
        where="process",
        means="SIGKILL of the task's process",
        step=clock_board.KILL,
        tasks=("executor", "planner", "clock"),
        detected_as=(DIED,),
        bound=bounds.by_rack_or(4),
        consequence=DEATH,
        once=True,
        within_tick=True,
    ),
    Kind(
        name="hang",
        where="process",
        means="SIGSTOP of the task's process",
        step=clock_board.HANG,
        detected_as=(Alarm.HANG,),
        # Four releases without an answer, and the release at which that is seen.
        bound=bounds.cycles(4 + 1),
        consequence=DEATH,
        lasts=draw.cycles(7, 10),
        within_tick=True,
    ),
    Kind(
        name="overrun",
        where="load",
        means="the executor computes for longer",
        step=tasks.overrun,
        tasks=("executor",),
        parameters=(
            Parameter("by", "cycles", "additional computing time", 1.5, 0.0, 100.0, drawn=draw.number(1.2, 2.5)),
            Parameter("random", "1", "1: uniformly between 0 and that", 0, 0, 1, is_whole=True),
        ),
        detected_as=(Alarm.LATE, Alarm.STARVED),
        # The next release comes before the end of the cycle.
        bound=bounds.cycles(1),
        lasts=draw.cycles(1, 4),
        realtime=True,
    ),
    Kind(
        name="planner-slow",
        where="load",
        means="the planner exceeds its time slice",
        step=tasks.slow_plan,
        tasks=("planner",),
        parameters=(Parameter("by", "cycles", "time beyond the slice", 2.0, 0.5, 100.0, drawn=draw.number(1.5, 4.0)),),
        detected_as=(Alarm.PLAN_LATE,),
        bound=bounds.SLICE + bounds.RELEASE,
        lasts=draw.longest(draw.cycles(3, 6), draw.seconds(1.0, 2.0)),
        realtime=True,
    ),
    Kind(
        name="hog",
        where="core",
        means="a process of higher priority takes the board's core",
        step=tasks.take_core,
        detected_as=(Alarm.STARVED,),
        bound=bounds.cycles(4 + 1),
        lasts=draw.longest(draw.cycles(7, 9), draw.seconds(0.1, 0.3)),
        realtime=True,
    ),
    Kind(
        name="mute",
        where="writer",
        means="no message is written",
        step=messages.Mute,
        detected_as=(Alarm.MUTE,),
        # Age alone would show after two periods, but proves nothing: the writer must have finished a release since.
        bound=bounds.missing_writes(2) + bounds.READ,
        lasts=draw.silence(1.2, 2.0),
    ),
    Kind(
        name="drop",
        where="writer",
        means="messages are lost",
        step=messages.Drop,
        parameters=(_probability(0.3, 0.9),),
        detected_as=(Alarm.GAP,),
        # The next message shows that one is missing.
        bound=bounds.writes(1) + bounds.DELIVERY,
        consequence=Consequence(own=(Alarm.MUTE,)),
        lasts=draw.messages(4, 8),
    ),
    Kind(
        name="delay",
        where="writer",
        means="messages are held back",
        step=messages.Delay,
        parameters=(
            Parameter("by", "cycles", "the writer's cycles of delay", 2, 1, 50, is_whole=True, drawn=draw.whole(1, 5)),
        ),
        # Until the first message comes there is none.
        detected_as=(Alarm.HELD_BACK, Alarm.MUTE),
        bound=bounds.delayed("by") + bounds.DELIVERY,
        # The first messages on time overtake the last ones held back.
        consequence=Consequence(own=(Alarm.DISORDER,)),
        lasts=draw.messages(9, 13),
    ),
    Kind(
        name="reorder",
        where="writer",
        means="two messages change places",
        step=messages.Reorder,
        parameters=(_probability(0.3, 0.9),),
        # The last message held back may find none to change places with.
        detected_as=(Alarm.DISORDER, Alarm.HELD_BACK),
        bound=bounds.writes(1) + bounds.DELIVERY,
        consequence=Consequence(own=(Alarm.MUTE,)),
        lasts=draw.messages(4, 8),
    ),
    Kind(
        name="corrupt",
        where="writer",
        means="bits of a message are flipped in its slot",
        step=messages.Corrupt,
        parameters=(
            _probability(1.0, 1.0),
            Parameter("bits", "1", "bits flipped", 3, 1, 64, is_whole=True, drawn=draw.whole(1, 16)),
        ),
        detected_as=(Alarm.DAMAGED,),
        bound=bounds.DELIVERY,
        consequence=DAMAGE,
        lasts=draw.messages(4, 8),
    ),
    Kind(
        name="babble",
        where="writer",
        means="messages are written without pause",
        step=messages.Babble,
        parameters=(Parameter("writes", "1", "messages a cycle", 32, 3, 1000, is_whole=True, drawn=draw.whole(8, 64)),),
        detected_as=(Alarm.BABBLE,),
        bound=bounds.DELIVERY,
        consequence=Consequence(own=(Alarm.DISORDER, Alarm.GAP)),
        lasts=draw.cycles(3, 6),
    ),
    Kind(
        name="masquerade",
        where="bus",
        means="a second writer forges a message",
        step=clock_board.MASQUERADE,
        detected_as=(Alarm.MASQUERADE,),
        bound=bounds.DELIVERY,
        consequence=Consequence(own=(Alarm.DISORDER, Alarm.GAP, Alarm.DAMAGED)),
        once=True,
        within_tick=True,
    ),
    Kind(
        name="lock-held",
        where="lock",
        means="the holder of a lock is stopped or killed",
        step=messages.HoldLock,
        parameters=(Parameter("killed", "1", "1: killed; 0: stopped", 0, 0, 1, is_whole=True, drawn=draw.whole(0, 1)),),
        detected_as=(Alarm.LOCKED, DIED),
        bound=bounds.LOCK_WAIT + bounds.READ,
        consequence=Consequence(own=(Alarm.STALE, Alarm.MUTE, Alarm.HANG), ends_process=True),
        realtime=True,
        once=True,
    ),
    Kind(
        name="clock-stop",
        where="clock",
        means="SIGSTOP of the clock's process",
        step=clock_board.CLOCK_STOP,
        tasks=("clock",),
        detected_as=(Alarm.CLOCK_STOPPED,),
        bound=bounds.clock_ticks(3),
        consequence=Consequence(reactions=("restart",), ends_process=True),
        lasts=draw.seconds(0.05, 0.3),
        realtime=True,
        once=True,
        within_tick=True,
    ),
    Kind(
        name="clock-skip",
        where="clock",
        means="ticks are skipped",
        step=clock_board.CLOCK_SKIP,
        tasks=("clock",),
        parameters=(Parameter("ticks", "ticks", "how many", 1, 1, 20, is_whole=True, drawn=draw.whole(1, 20)),),
        detected_as=(Alarm.CLOCK_SKIPPED,),
        bound=bounds.skipped("ticks"),
        once=True,
    ),
    Kind(
        name="clock-jitter",
        where="clock",
        means="ticks are late",
        step=clock_board.CLOCK_JITTER,
        tasks=("clock",),
        parameters=(
            Parameter(
                "late", "ticks", "largest lateness; at least 0.6", 0.9, 0.65, 0.95, drawn=draw.number(0.75, 0.95)
            ),
        ),
        detected_as=(Alarm.CLOCK_LATE,),
        bound=bounds.clock_ticks(2),
        lasts=draw.seconds(0.2, 0.6),
        realtime=True,
    ),
    Kind(
        name="sensor-nan",
        where="arm",
        means="a position is NaN",
        step=arm.SensorStep(arm.position_nan),
        parameters=(_joint(),),
        detected_as=(Alarm.SENSOR_RANGE,),
        bound=bounds.cycles(1),
        consequence=SENSOR,
        lasts=draw.seconds(0.02, 0.3),
    ),
    Kind(
        name="sensor-stuck",
        where="arm",
        means="position and velocity do not change",
        step=arm.SensorStep(arm.sample_stuck),
        # A joint at rest does not show that its sensor is stuck: in some faults all are stuck, for long enough.
        parameters=(_joint(draw.joint_or_all),),
        # Torques that move a joint whose velocity does not change look like a motor that gives nothing.
        detected_as=(Alarm.SENSOR_STUCK, Alarm.SENSOR_MODEL, Alarm.ACTUATOR),
        bound=bounds.cycles(20),
        consequence=SENSOR,
        lasts=draw.seconds(0.5, 1.5),
    ),
    Kind(
        name="sensor-dropout",
        where="arm",
        means="no new sample comes",
        step=arm.SensorStep(arm.sample_missing),
        detected_as=(Alarm.SENSOR_SILENT,),
        bound=bounds.cycles(2),
        consequence=SENSOR,
        lasts=draw.seconds(0.02, 0.3),
    ),
    Kind(
        name="sensor-bias",
        where="arm",
        means="a position has an offset",
        step=arm.SensorStep(arm.position_biased),
        parameters=(_joint(), _size("the offset", BIAS_RAD, 1e-5, 3.0)),
        detected_as=(Alarm.SENSOR_MODEL,),
        bound=bounds.BY_SIZE,
        consequence=SENSOR,
        lasts=draw.seconds(0.1, 0.5),
        visible_from=BIAS_RAD,
    ),
    Kind(
        name="sensor-noise",
        where="arm",
        means="a position has noise",
        step=arm.SensorStep(arm.position_noisy),
        parameters=(_joint(), _size("standard deviation", NOISE_RAD, 1e-6, 1.0)),
        detected_as=(Alarm.SENSOR_MODEL,),
        bound=bounds.BY_SIZE,
        consequence=SENSOR,
        lasts=draw.seconds(0.1, 0.5),
        visible_from=NOISE_RAD,
    ),
    Kind(
        name="actuator-off",
        where="arm",
        means="a motor gives no torque",
        step=arm.MotorStep(lambda fault: 0.0),
        parameters=(_joint(default=1),),
        detected_as=(Alarm.ACTUATOR,),
        bound=bounds.cycles(5),
        consequence=MOTOR,
        lasts=draw.seconds(0.05, 0.4),
    ),
    Kind(
        name="actuator-saturated",
        where="arm",
        means="a motor gives only a part of its torque",
        step=arm.MotorStep(lambda fault: fault["part"]),
        parameters=(
            _joint(default=1),
            Parameter("part", "1", "of its largest torque", 0.1, 0.0, 0.9, drawn=draw.number(0.0, 0.05)),
        ),
        detected_as=(Alarm.ACTUATOR,),
        # The motor acts like a load that pulls, until more torque is asked for and no more comes. The joint loop asks
        # for more by 0.3 of the missing torque in a cycle (twice its bandwidth, 60 rad/s, times the cycle), and a sound
        # motor gives at least 0.3 of that. Dry friction that reverses may replace all that is missing when the fault
        # strikes: 1 / (0.3 * 0.3) cycles.
        bound=bounds.cycles(12),
        consequence=MOTOR,
        lasts=draw.seconds(0.05, 0.4),
    ),
    Kind(
        name="command-nan",
        where="arm",
        means="a torque is NaN",
        step=arm.CommandStep(arm.torque_nan),
        parameters=(_joint(),),
        detected_as=(Alarm.COMMAND_INVALID,),
        # At the limit gate, in the same cycle: the torque never reaches the arm.
        bound=bounds.cycles(0),
        consequence=COMMAND,
        lasts=draw.seconds(0.01, 0.2),
    ),
    Kind(
        name="command-limit",
        where="arm",
        means="a torque is far beyond its limit",
        step=arm.CommandStep(arm.torque_excessive),
        parameters=(
            _joint(),
            Parameter("factor", "1", "times the limit", 5.0, 1.1, 1e6, drawn=draw.magnitude(3.0, 1000.0)),
        ),
        detected_as=(Alarm.COMMAND_LIMIT,),
        bound=bounds.cycles(0),
        consequence=COMMAND,
        lasts=draw.seconds(0.01, 0.2),
    ),
    Kind(
        name="self-test",
        where="start",
        means="the start-up test fails",
        detected_as=(),
        bound=bounds.NOT_ARMED,
        once=True,
    ),
)
