"""Whatever a board drives, arm or hand: its time, its counters, and the messages that they fill."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message
from rack.backplane.watch.alarms import Alarm
from rack.levels.arm.poses import poses, show
from rack.levels.level import Executor, Finding
from rack.levels.messages import Error
from rack.levels.robot.cell import Cell

EPISODE_TICKS = 20
"""Ticks without a finding of a kind after which the next one is reported again."""


class Plant:
    """Time, counters and state of a driven mechanism in a cell; `ARM_STATE` and `SCENE` are filled
    from them.

    Its `findings` are those of the level that makes it: they reach the board, and the counters the
    state, even if the level reports nothing.
    """

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.findings: list[Finding] = []  # once per episode
        if Executor.made_last is not None:
            self.findings = Executor.made_last.findings
            Executor.made_last.complete_cycle.append(self.complete_cycle)
        self._found_ticks: dict[Alarm, int] = {}  # of the last finding of each kind
        self._reported_tick = -1  # of the last cycle that was reported
        self.tick = 0  # tick of the state
        self.waited = 0  # ticks since the last command
        # held without commands: the brakes of an arm are engaged, the valves of a hand closed
        self.braked = True
        self.fault = ""  # why it has failed and moves no more; empty: it has not
        self.clipped = 0  # cycles in which a command was refused or cut
        self.brake_cause: int = Error.NONE  # of brakes that engage in this cycle: see their alarm
        self.contact: tuple[int, int] | None = (
            None  # geoms of an unintended contact, of it or its load, in a step
        )
        self.touches = 0  # unintended contacts so far
        self.first_touch = ""  # the first of them, readable: which geoms, and when
        self.violations = (
            0  # steps in which the drives broke a limit of position, velocity or torque
        )
        self.struck = 0  # ticks for which the motion is still blamed on a blow
        self.pushed = (
            0  # steps in which a blow pushed a joint beyond a limit of position or velocity
        )
        # the first violation, readable: which limit, by how much, and when
        self.first_violation = ""
        self._saved: tuple[Message, tuple[int, ...]] | None = (
            None  # last message filled, with what seldom changes
        )
        self._data = cell.start()
        self._poses = poses(cell, self._data)
        self._fill = show.load()

    def _show(self, scene: Message) -> None:
        """Fill a `SCENE` from `_data`."""
        self._fill(*self._poses, np.frombuffer(scene.raw))

    def save(self, state: Message) -> None:
        """Fill an `ARM_STATE` with the state that a restarted board needs. Default: the attributes.

        A simulation adds its state: `state.state` has room for it, see `rack.levels.robot.state`.
        """
        self.report_cycle()
        state.tick = self.tick
        seldom = (
            self.waited,
            self.braked,
            self.clipped,
            self.touches,
            self.violations,
            self.pushed,
            self.struck,
        )
        if (state, seldom) != self._saved:
            state.waited, state.braked, state.clipped, state.touches = seldom[:4]
            state.violations, state.pushed, state.struck = seldom[4:]
            self._saved = state, seldom

    def find(self, finding: Finding) -> None:
        """Add a finding, unless it continues an episode."""
        last = self._found_ticks.get(finding.alarm)
        if last is None or self.tick - last > EPISODE_TICKS:
            self.findings.append(finding)
        self._found_ticks[finding.alarm] = self.tick

    def refuse(self, finding: Finding) -> Finding:
        """Count and report a command that must not be applied as it is; return why."""
        self.clipped += 1
        self.find(finding)
        self.brake_cause = Error.LIMIT
        return finding

    def report_cycle(self) -> None:
        """Add to the findings what a cycle did, at its end."""
        self._reported_tick = self.tick

    def complete_cycle(self, state: Message | None) -> None:
        """Report a cycle, and fill its `ARM_STATE`, unless the level has saved it."""
        if self._reported_tick != self.tick:
            if state is not None:
                self.save(state)
            self.report_cycle()

    def restore(self, state: Message) -> None:
        """Continue from an `ARM_STATE`: called once, before the first `step`, on a restarted
        board."""
        self.tick = state.tick
        self.waited = state.waited
        self.braked = bool(state.braked)
        self.clipped = state.clipped
        self.touches = state.touches
        self.violations = state.violations
        self.pushed = state.pushed
        self.struck = state.struck
