"""Executor of the board that drives a hand. It applies commanded tensions or closes the valves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Demand
from rack.levels.algebra import Array
from rack.levels.arm import substeps
from rack.levels.arm.commands_above import CommandsAbove, check_commanders
from rack.levels.fault_steps import TendonStep
from rack.levels.level import (
    OPERATOR,
    Executor,
    Fault,
    Finding,
    Input,
    Inputs,
    LevelContext,
    Mismatches,
    Output,
    Reading,
)
from rack.levels.messages import ArmState, Error
from rack.levels.operator import HOLD_COMMANDS
from rack.levels.robot.cell import build_level_cell
from rack.levels.robot.hand import Hand
from rack.levels.robot.limits import MotorPatience
from rack.levels.servo.driver import SCENES
from rack.levels.systems.hand.messages import HandStatus, TensionCommand
from rack.levels.systems.hand.simulated import HandSample, SimulatedHand
from rack.levels.tables import Table

HELD = "held by the operator: valves closed; `resume` opens them"
DEMANDED = "demand '{}' on the hand: valves closed until boards and emergency stop are in order"
TENDONS = ("flexor", "extensor")
"""Names of the rows of tensions."""


class HandExecutor(Executor):
    """Drives a hand with the tensions of the boards above.

    A hand has no brakes, and releasing its grip is not safe. The valves of all tendons therefore
    close on a safety demand (including an emergency stop), on an operator's HOLD, while a board
    above is lost or late, and while a tension is NaN. Closed valves keep the grip and bring moving
    fingers to rest, see `SimulatedHand`. They open again, following the current commands, once all
    boards above have received the status that reports them as closed.
    """

    tensions = Inputs(TensionCommand, "above.command")
    before = Input(ArmState, "own.state")
    operator = OPERATOR
    status = Output(HandStatus)
    state = Output(ArmState)
    scene = SCENES
    commands = HOLD_COMMANDS
    params = Table
    faults = (TendonStep,)
    preloads = (substeps,)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_level_cell(context)
        assert cell.hand is not None, "`find_mismatches` refuses a robot without a hand"
        self.hand = SimulatedHand(
            cell, context.scene, context.clock_ns, context.every, context.seed
        )
        self.wanted_tensions = Tensions(context, cell.hand, cell.patience)
        self._started = False  # whether the first cycle has begun
        # Tick of the first status with closed valves. None while they are open.
        self._closed_at: int | None = 0
        self._opened = False  # whether the valves have ever been open, including before a restart
        self._waiting = ""  # reason for closed valves, empty while they are open
        self._slack = SlackMonitor(cell.hand, context.robot.joints)
        self._torn: dict[int, bool] = {}  # injected faults that tore a tendon, as in `acted`

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Report a missing `[robot.hand]` and joints not driven by exactly one board above."""
        hand = context.robot.hand
        if hand is None:
            why = "this board drives a hand; [robot.hand] is missing"
            yield "executor", cls.__name__, why
            return
        joints: dict[str | None, Sequence[str]] = {one.name: one.joints for one in hand.finger}
        joints[None] = context.robot.joints
        yield from check_commanders(
            context,
            {
                board: joints.get(pace.params.get("finger"), ())
                for board, pace in context.above.items()
            },
        )

    def inject(self, faults: Sequence[Fault]) -> None:
        """Tear the tendons in `faults` and mend all others. Unknown joints are ignored."""
        torn = np.zeros(self.wanted_tensions.tension.shape, dtype=bool)
        self._torn = {}
        for place, fault in enumerate(faults):
            struck = fault.mark_joints(torn.shape[1])
            torn[int(fault.parameters["side"])] |= struck
            if struck.any():
                self._torn[place] = True
        self.hand.tear_tendons(torn)

    def process(self, tick: int) -> None:
        """Advance the hand to `tick`, read its sensors, command the valves and write the status."""
        hand = self.hand
        # Advance the hand to tick. A restarted board first restores it.
        if not self._started:
            self._started = True
            if self.before.has_message:
                self.hand.restore(self.before.message)
                self._opened = True
            self._closed_at = tick
        hand.late_s = self.late_s
        self.hand.step(tick - self.hand.tick)
        # The hand closes its valves by itself if no tensions arrive in time.
        if self.hand.braked and self._closed_at is None:
            self._closed_at = tick
        self._orders.take_commands(self.operator)
        sample = hand.sense()
        self.findings += self._slack.check_tensions(sample.tension, hand.commanded_tensions)
        self.acted |= self._torn
        self._command_valves(tick)
        self._fill_status(self.status, sample, tick)
        self._orders.fill_status(self.status, self.wanted_tensions.rests_on)
        hand.save(self.state)
        if SCENES.is_due(tick, self.context.every, self.context.phase):
            hand.look(self.scene)

    def _command_valves(self, tick: int) -> None:
        """Apply the tensions of the boards above, or close the valves and store the reason."""
        since = self._closed_at if self._opened else 0
        self._waiting = self.wanted_tensions.find_missing(self.tensions, tick, since or 0)
        if not self._waiting:
            self.wanted_tensions.merge_commands(self.tensions)
            finding, self._waiting = self.wanted_tensions.limit_tensions()
            if finding is not None:
                self.hand.refuse_command(finding)
        held = self._orders.is_holding
        if held and not self._waiting:
            self._waiting = HELD
        if self.demand is not Demand.NONE:
            self._waiting = DEMANDED.format(self.demand.name.lower())
        if self._waiting:
            if self._closed_at is None:
                self._closed_at = tick
            self.hand.close_valves()
            if held:
                self._orders.report_done()
        else:
            self._closed_at = None
            self._opened = True
            self.hand.apply_tensions(self.wanted_tensions.tension)

    def _fill_status(self, status: HandStatus, sample: HandSample, tick: int) -> None:
        """Fill the status with the sample, the state of the valves and any error."""
        hand = self.hand
        status.tick = tick
        for name, value in sample._asdict().items():
            setattr(status, name, value)
        status.wanted = hand.commanded_tensions
        closed = bool(self._waiting)
        status.holding = closed
        status.stopped = closed and self._opened
        status.demand = self.demand
        status.clipped = hand.clipped
        status.touches = hand.touches
        status.violations = hand.violations
        status.pushed = hand.pushed
        if hand.fault:
            status.state = State.ERROR
            status.error = Error.SIMULATION
            status.reason = hand.fault
            return
        if closed:
            status.state = State.HOLDING if self._opened else State.IDLE
        else:
            status.state = State.EXECUTING
        touched = Error.TOUCHED if hand.touches else Error.NONE
        status.error = Error.LIMIT if hand.violations else touched
        status.reason = (
            self._waiting or hand.first_violation or hand.first_touch or self._slack.note
        )


SLACK_CYCLES = 5
"""Consecutive slack cycles after which a tendon counts as torn. An opening valve takes up to four
cycles to tighten a tendon."""
SLACK_PART = 0.5
"""Fraction of the least tension below which a tendon is slack.

The tension of an intact tendon stays above it.
"""


class SlackMonitor:
    """Detects torn tendons from the sensed tensions."""

    def __init__(self, hand: Hand, joints: Sequence[str]) -> None:
        self._joints = joints
        self._least = hand.least
        self._slack = SLACK_PART * hand.least
        self._cycles = np.zeros((2, len(joints)), dtype=int)  # consecutive slack cycles
        self._any = False  # whether a tendon was slack in the last cycle
        self.note = ""  # text that lists the slack tendons, empty without any

    def check_tensions(self, tension: Array, wanted: Array) -> list[Finding]:
        """Return a finding for each tendon that is detected as torn in this cycle.

        A tendon counts as torn after `SLACK_CYCLES` successive cycles in which it is slack although
        tension is commanded.

        Args:
            tension: Sensed tensions, (2, joints), N.
            wanted: Commanded tensions, (2, joints), N.
        """
        if tension.min() >= self._slack and not self._any:
            return []
        slack = (tension < self._slack) & (wanted >= self._least)
        self._cycles = np.where(slack, self._cycles + 1, 0)
        self._any = bool(slack.any())
        torn = np.argwhere(self._cycles >= SLACK_CYCLES).tolist()
        named = ", ".join(f"{TENDONS[row]} of '{self._joints[joint]}'" for row, joint in torn)
        self.note = f"slack: {named}" if named else ""
        found = np.argwhere(self._cycles == SLACK_CYCLES).tolist()
        return [Finding(Alarm.TENDON, joint, float(tension[row, joint])) for row, joint in found]


MARGIN = 1e-3
"""Fraction of the largest tension by which a command may exceed its limits without a finding, for
rounding errors."""


class Tensions(CommandsAbove):
    """Merges the `TensionCommand`s of the boards above, each for the joints that it drives."""

    def __init__(self, context: LevelContext, hand: Hand, patience: MotorPatience) -> None:
        # A tension is delayed by a cycle of its board and by a cycle of the joint loop above that.
        super().__init__(context, patience, 2, "tensions", "valves closed")
        self._joints = context.robot.joints
        self._low = hand.least
        self._high = hand.most
        self._margin = MARGIN * hand.most
        self.tension = np.zeros((2, len(hand.most)))  # N
        self.rests_on = 0  # serial of the newest operator command on which the tensions depend

    def merge_commands(self, tensions: Mapping[str, Reading[TensionCommand]]) -> None:
        """Merge the commands of all boards into `tension`.

        Call this only if `find_missing` has found no missing command.
        """
        self.rests_on = 0
        for board in self.oldest:
            value = tensions[board].message
            self.rests_on = max(self.rests_on, value.operator)
            np.copyto(self.tension, value.tension, where=value.driven != 0)

    def limit_tensions(self) -> tuple[Finding | None, str]:
        """Limit `tension` to its range, and reject it if it contains NaN.

        Returns:
            The finding, or None if every tension is in range; and the reason for rejecting the
            tensions, empty if they are accepted.
        """
        tension = self.tension
        low = self._low
        high = self._high
        finding = None
        within = (tension >= low - self._margin) & (tension <= high + self._margin)  # False for NaN
        if not within.all():
            finite = np.isfinite(tension)
            if not finite.all():
                row, joint = np.argwhere(~finite)[0].tolist()
                refused = f"rejected: tension of '{self._joints[joint]}', {TENDONS[row]} is NaN"
                return Finding(Alarm.TENSION_INVALID, joint), refused
            row, joint = np.argwhere(~within)[0].tolist()
            finding = Finding(Alarm.TENSION_LIMIT, joint, float(tension[row, joint]))
        np.clip(tension, low, high, out=tension)
        return finding, ""
