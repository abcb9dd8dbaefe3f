"""The fault kinds of this project, in the order in which `rack inject --list` shows them."""

from __future__ import annotations

from functools import partial

from rack.backplane.watch.alarms import Alarm
from rack.boards.faults import clock_board, tasks
from rack.boards.faults import message_steps as messages
from rack.boards.faults.bounds import (
    BY_SIZE,
    DEATH,
    DELAY,
    DELIVERY,
    LOCK_WAIT,
    MUTE,
    NOT_ARMED,
    READ,
    RELEASE,
    SKIP,
    SLICE,
    cycle_and_time_bound,
    cycle_bound,
    tick_bound,
    write_bound,
)
from rack.boards.faults.drawing import (
    MAX_SIZE_RATIO,
    Draw,
    draw_joint,
    draw_joint_or_all,
    log_uniform_number,
    longest_of,
    uniform_cycles,
    uniform_integer,
    uniform_messages,
    uniform_number,
    uniform_seconds,
    uniform_silence,
)
from rack.boards.faults.kind import DIED, KINDS, Consequence, Kind, Parameter
from rack.levels import fault_steps as arm

BRAKED = ("brakes_closed",)
PROCESS_ENDS = Consequence(
    own=(Alarm.STALE, Alarm.MUTE, Alarm.CLOCK_STOPPED), reactions=("restart",), ends_process=True
)
SENSOR = Consequence(
    arm=(Alarm.SENSOR_RANGE, Alarm.SENSOR_STUCK, Alarm.SENSOR_SILENT, Alarm.SENSOR_MODEL),
    reactions=BRAKED,
    recovery_s=1.0,
    latches=True,
)
# A failed motor is retried every 0.5 s: the brakes are released, and engage again within 12 cycles
# if it still fails. An alarm about any other motor is a false alarm.
MOTOR = Consequence(reactions=BRAKED, recovery_s=0.6, latches=True)
COMMAND = Consequence(reactions=BRAKED)
# Any word of the message's head may be damaged: its serial, its ticks, its writer.
DAMAGE = Consequence(own=(Alarm.GAP, Alarm.HELD_BACK, Alarm.DISORDER, Alarm.MASQUERADE, Alarm.MUTE))
BIAS_RAD = 0.02
NOISE_RAD = 0.005
"""Smallest sensor error, in rad, that must be detected."""


# Constructors of kinds that act in the same place and have the same consequences.
_clock = partial(Kind, where="clock", tasks=("clock",))
_message = partial(Kind, where="writer")
_sensor = partial(Kind, where="arm", consequence=SENSOR)
_motor = partial(
    Kind,
    where="arm",
    consequence=MOTOR,
    detected_as=(Alarm.ACTUATOR,),
    lasts=uniform_seconds(0.05, 0.4),
)
# The limit gate finds a bad torque in the same cycle, before it reaches the arm.
_torque = partial(
    Kind,
    where="arm",
    consequence=COMMAND,
    bound=cycle_bound(0),
    lasts=uniform_seconds(0.01, 0.2),
)


def _joint_parameter(drawn: Draw = draw_joint, default: float = 0) -> Parameter:
    """Return the parameter that selects a joint."""
    return Parameter(
        "joint", "1", "joint, counted from 0 (-1: all)", default, -1, 15, is_whole=True, drawn=drawn
    )


JOINT = _joint_parameter()


def _probability_parameter(default: float, most: float) -> Parameter:
    """Return the parameter for the probability that a message is affected."""
    return Parameter(
        "probability",
        "1",
        "probability that a message is affected",
        default,
        0.001,
        1.0,
        drawn=uniform_number(0.5, most),
    )


# Messages arrive late or never, with a probability. The next message shows it.
_lossy = partial(
    _message,
    parameters=(_probability_parameter(0.3, 0.9),),
    bound=write_bound(1) + DELIVERY,
    consequence=Consequence(own=(Alarm.MUTE,)),
    lasts=uniform_messages(4, 8),
)


def _size_parameter(meaning: str, visible: float, least: float, most: float) -> Parameter:
    """Return the parameter for the size of a sensor error.

    Campaigns draw it from `visible` to `MAX_SIZE_RATIO` times `visible`.
    """
    return Parameter(
        "size",
        "rad",
        meaning,
        visible,
        least,
        most,
        drawn=log_uniform_number(visible, MAX_SIZE_RATIO * visible),
    )


# The size of an error decides when the monitor finds it.
_sized = partial(
    _sensor,
    detected_as=(Alarm.SENSOR_MODEL,),
    bound=BY_SIZE,
    lasts=uniform_seconds(0.1, 0.5),
)

KINDS.add(
    Kind(
        name="kill",
        where="process",
        means="SIGKILL kills the task's process",
        step=clock_board.KILL,
        tasks=("executor", "planner", "clock", "host"),
        detected_as=(DIED,),
        bound=DEATH,
        consequence=PROCESS_ENDS,
        once=True,
        within_tick=True,
    ),
    Kind(
        name="hang",
        where="process",
        means="SIGSTOP stops the task's process",
        step=clock_board.HANG,
        tasks=("executor", "planner", "host"),
        detected_as=(Alarm.HANG,),
        # Four missed releases, plus the release at which the reader notices them.
        bound=cycle_bound(4 + 1),
        consequence=PROCESS_ENDS,
        lasts=uniform_cycles(7, 10),
        within_tick=True,
    ),
    Kind(
        name="overrun",
        where="load",
        means="the executor computes longer",
        step=tasks.compute_cycle_end,
        tasks=("executor",),
        parameters=(
            Parameter(
                "by",
                "cycles",
                "extra computing time",
                1.5,
                0.0,
                100.0,
                drawn=uniform_number(1.2, 2.5),
            ),
            Parameter(
                "random",
                "1",
                "1 for a delay drawn uniformly from 0 to `by`, 0 for always `by`",
                0,
                0,
                1,
                is_whole=True,
            ),
        ),
        detected_as=(Alarm.LATE, Alarm.STARVED),
        # The cycle is still running at its next release.
        bound=cycle_bound(1),
        lasts=uniform_cycles(1, 4),
    ),
    Kind(
        name="planner-slow",
        where="load",
        means="the planner exceeds its time slice",
        step=tasks.compute_slice_end,
        tasks=("planner",),
        parameters=(
            Parameter(
                "by",
                "cycles",
                "time beyond its slice",
                2.0,
                0.5,
                100.0,
                drawn=uniform_number(1.5, 4.0),
            ),
        ),
        detected_as=(Alarm.PLAN_LATE,),
        bound=SLICE + RELEASE,
        lasts=longest_of(uniform_cycles(3, 6), uniform_seconds(1.0, 2.0)),
    ),
    Kind(
        name="hog",
        where="core",
        means="a higher-priority process takes the board's core",
        step=tasks.take_core,
        detected_as=(Alarm.STARVED,),
        bound=cycle_bound(4 + 1),
        lasts=longest_of(uniform_cycles(7, 9), uniform_seconds(0.1, 0.3)),
    ),
    _message(
        name="mute",
        means="the task runs but writes no messages",
        step=messages.Mute,
        detected_as=(Alarm.MUTE,),
        not_queued="a queue is written on demand: its silence proves nothing",
        # A message is stale after two periods, but that proves nothing until its writer has
        # finished another release.
        bound=MUTE + READ,
        lasts=uniform_silence(1.2, 2.0),
    ),
    _lossy(
        name="drop",
        means="messages are lost",
        step=messages.Drop,
        # The next message makes the gap in the serials visible.
        detected_as=(Alarm.GAP,),
    ),
    _message(
        name="delay",
        means="messages are delayed",
        step=messages.Delay,
        parameters=(
            Parameter(
                "by",
                "cycles",
                "delay, in the writer's cycles",
                2,
                1,
                50,
                is_whole=True,
                drawn=uniform_integer(1, 5),
            ),
        ),
        # Until the first delayed message arrives, the mailbox gets no messages.
        detected_as=(Alarm.HELD_BACK, Alarm.MUTE),
        bound=DELAY + DELIVERY,
        # Afterwards the first punctual messages overtake the last delayed ones.
        consequence=Consequence(own=(Alarm.DISORDER,)),
        lasts=uniform_messages(9, 13),
    ),
    _lossy(
        name="reorder",
        means="consecutive messages are swapped",
        step=messages.Reorder,
        # If the last message has no successor to be swapped with, it is only late.
        detected_as=(Alarm.DISORDER, Alarm.HELD_BACK),
        not_queued="the messages of one cycle have the same tick: nothing would show their order",
    ),
    _message(
        name="corrupt",
        means="bits of a message are flipped",
        step=messages.Corrupt,
        parameters=(
            _probability_parameter(1.0, 1.0),
            Parameter(
                "bits",
                "1",
                "number of bits flipped",
                3,
                1,
                64,
                is_whole=True,
                drawn=uniform_integer(1, 16),
            ),
        ),
        detected_as=(Alarm.DAMAGED,),
        bound=DELIVERY,
        consequence=DAMAGE,
        lasts=uniform_messages(4, 8),
    ),
    Kind(
        name="wrong-output",
        where="copy",
        means="one copy of a task computes a wrong value",
        step=messages.WrongOutput,
        tasks=("executor",),
        parameters=(
            Parameter(
                "field",
                "1",
                "index of the wrong field in the message (-1: drawn from the seed)",
                -1,
                -1,
                1000,
                is_whole=True,
            ),
            Parameter(
                "bit",
                "1",
                "bit of the field to flip, modulo its size (-1: drawn from the seed)",
                -1,
                -1,
                1e6,
                is_whole=True,
            ),
            Parameter(
                "offset",
                "1",
                "number to add to the field, in its unit, instead of flipping a bit",
                0,
                -1e6,
                1e6,
            ),
        ),
        # Only a comparison with another copy can find it.
        detected_as=(Alarm.DIFFERS, Alarm.STRAYED),
        not_queued="a level with a queue has no standby, so nothing would find it",
        bound=cycle_bound(1) + tick_bound(1),
        # A vote takes the copy out.
        consequence=Consequence(ends_process=True),
        lasts=uniform_messages(1, 1),
    ),
    _message(
        name="babble",
        means="the task floods its mailboxes",
        step=messages.Babble,
        parameters=(
            Parameter(
                "writes",
                "1",
                "messages per cycle",
                32,
                3,
                1000,
                is_whole=True,
                drawn=uniform_integer(8, 64),
            ),
        ),
        detected_as=(Alarm.BABBLE,),
        not_queued=(
            "a queue takes several messages in a cycle, and refuses those that it cannot hold"
        ),
        bound=DELIVERY,
        consequence=Consequence(own=(Alarm.DISORDER, Alarm.GAP)),
        lasts=uniform_cycles(3, 6),
    ),
    Kind(
        name="masquerade",
        where="bus",
        means="another process forges a message",
        step=clock_board.MASQUERADE,
        detected_as=(Alarm.MASQUERADE,),
        bound=DELIVERY,
        consequence=Consequence(own=(Alarm.DISORDER, Alarm.GAP, Alarm.DAMAGED)),
        once=True,
        within_tick=True,
    ),
    Kind(
        name="lock-held",
        where="lock",
        means="the task is stopped or killed while it holds a lock",
        step=messages.HoldLock,
        parameters=(
            Parameter(
                "killed",
                "1",
                "1: killed; 0: stopped",
                0,
                0,
                1,
                is_whole=True,
                drawn=uniform_integer(0, 1),
            ),
        ),
        detected_as=(Alarm.LOCKED, DIED),
        bound=LOCK_WAIT + READ,
        consequence=Consequence(own=(Alarm.STALE, Alarm.MUTE, Alarm.HANG), ends_process=True),
        realtime=True,
        once=True,
    ),
    _clock(
        name="clock-stop",
        means="SIGSTOP stops the clock's process",
        step=clock_board.CLOCK_STOP,
        detected_as=(Alarm.CLOCK_STOPPED,),
        bound=tick_bound(3),
        consequence=Consequence(reactions=("restart",), ends_process=True),
        lasts=uniform_seconds(0.05, 0.3),
        realtime=True,
        once=True,
        within_tick=True,
    ),
    _clock(
        name="clock-skip",
        means="the clock skips ticks",
        step=clock_board.CLOCK_SKIP,
        parameters=(
            Parameter(
                "ticks",
                "ticks",
                "number of ticks skipped",
                1,
                1,
                20,
                is_whole=True,
                drawn=uniform_integer(1, 20),
            ),
        ),
        detected_as=(Alarm.CLOCK_SKIPPED,),
        bound=SKIP,
        once=True,
    ),
    _clock(
        name="clock-jitter",
        means="the clock ticks late",
        step=clock_board.CLOCK_JITTER,
        parameters=(
            Parameter(
                "late",
                "ticks",
                "largest delay of a tick",
                0.9,
                0.01,
                0.95,
                drawn=uniform_number(0.75, 0.95),
            ),
            Parameter("least", "ticks", "smallest delay of a tick", 0.6, 0.0, 0.95),
        ),
        detected_as=(Alarm.CLOCK_LATE,),
        bound=tick_bound(2),
        # In lockstep a simulated arm is sampled and driven late, unlike its model.
        consequence=Consequence(arm=(Alarm.SENSOR_MODEL, Alarm.ACTUATOR), recovery_s=1.0),
        lasts=uniform_seconds(0.2, 0.6),
    ),
    _sensor(
        name="sensor-nan",
        means="a joint position is NaN",
        step=arm.SensorStep(arm.set_position_nan),
        parameters=(JOINT,),
        detected_as=(Alarm.SENSOR_RANGE,),
        bound=cycle_bound(1),
        lasts=uniform_seconds(0.02, 0.3),
    ),
    _sensor(
        name="sensor-stuck",
        means="joint position and velocity freeze",
        step=arm.SensorStep(arm.freeze_sample),
        # A stuck sensor cannot be noticed while its joint is at rest, so some draws freeze all
        # joints for long enough that one of them moves.
        parameters=(_joint_parameter(draw_joint_or_all),),
        # A joint that is driven but shows no velocity looks like one whose motor produces no
        # torque.
        detected_as=(Alarm.SENSOR_STUCK, Alarm.SENSOR_MODEL, Alarm.ACTUATOR),
        bound=cycle_bound(20),
        lasts=uniform_seconds(0.5, 1.5),
    ),
    _sensor(
        name="sensor-dropout",
        means="no new samples arrive",
        step=arm.SensorStep(arm.repeat_last_sample),
        detected_as=(Alarm.SENSOR_SILENT,),
        bound=cycle_bound(2),
        lasts=uniform_seconds(0.02, 0.3),
    ),
    _sized(
        name="sensor-bias",
        means="a joint position has an offset",
        step=arm.SensorStep(arm.bias_position),
        parameters=(JOINT, _size_parameter("offset", BIAS_RAD, 1e-5, 3.0)),
        visible_from=BIAS_RAD,
    ),
    _sized(
        name="sensor-noise",
        means="a joint position is noisy",
        step=arm.SensorStep(arm.add_position_noise),
        parameters=(
            JOINT,
            _size_parameter("standard deviation", NOISE_RAD, 1e-6, 1.0),
        ),
        visible_from=NOISE_RAD,
    ),
    _motor(
        name="actuator-off",
        means="a motor produces no torque",
        step=arm.MotorStep(lambda fault: 0.0),
        parameters=(_joint_parameter(default=1),),
        # Dry friction hides the fault for a time, which is more cycles if cycles are shorter.
        bound=cycle_and_time_bound(5, 12_500_000),
    ),
    _motor(
        name="actuator-saturated",
        means="a motor produces only part of its torque",
        step=arm.MotorStep(lambda fault: fault["part"]),
        parameters=(
            _joint_parameter(default=1),
            Parameter(
                "part",
                "1",
                "fraction of its maximum torque",
                0.1,
                0.0,
                0.9,
                drawn=uniform_number(0.0, 0.05),
            ),
        ),
        # At first this looks like an external load. It shows once the commanded torque rises and
        # the motor's torque does not. In each cycle the joint loop adds 0.3 of the missing torque
        # to its command (twice its bandwidth of 60 rad/s, times the cycle); a working motor would
        # deliver at least 0.3 of that. In the worst case, reversing dry friction hides all of the
        # missing torque at first, which gives 1 / (0.3 * 0.3) cycles. The time is a lower limit
        # because the command rises by less in each cycle if cycles are shorter.
        bound=cycle_and_time_bound(12, 30_000_000),
    ),
    Kind(
        name="tendon-torn",
        where="arm",
        means="a tendon of a hand gives no tension",
        step=arm.TendonStep(),
        parameters=(
            JOINT,
            Parameter("side", "1", "0: the flexor; 1: the extensor", 0, 0, 1, is_whole=True),
        ),
        detected_as=(Alarm.TENDON,),
        # Five successive cycles with slack; the first sample after the tear is one cycle late.
        bound=cycle_bound(5 + 1),
        lasts=uniform_seconds(0.05, 0.4),
    ),
    _torque(
        name="command-nan",
        means="a commanded torque is NaN",
        step=arm.CommandStep(arm.set_torque_nan),
        parameters=(JOINT,),
        detected_as=(Alarm.COMMAND_INVALID,),
    ),
    _torque(
        name="command-limit",
        means="a commanded torque is far beyond its limit",
        step=arm.CommandStep(arm.exceed_torque),
        parameters=(
            JOINT,
            Parameter(
                "factor",
                "1",
                "multiple of the torque limit",
                5.0,
                1.1,
                1e6,
                drawn=log_uniform_number(3.0, 1000.0),
            ),
        ),
        detected_as=(Alarm.COMMAND_LIMIT,),
    ),
    Kind(
        name="self-test",
        where="start",
        means="the start-up self-test fails",
        detected_as=(),
        bound=NOT_ARMED,
        once=True,
    ),
)
BUILT_IN = frozenset(KINDS.names)
"""Names of the kinds in this file, which every process knows."""
