"""Whatever a board drives, arm or hand: its time, its counters, and the messages that they fill."""

from __future__ import annotations

from operator import attrgetter

import mujoco

from rack.backplane.watch.alarms import Alarm
from rack.levels.level import Executor, Finding
from rack.levels.messages import ArmState, Error, Scene
from rack.levels.robot.cell import Cell

EPISODE_TICKS = 20
"""Ticks without a finding of a kind after which the next one is reported again."""
SAVED = ("waited", "braked", "clipped", "touches", "violations", "pushed", "struck")
"""Attributes of a plant that its `ArmState` keeps, and that seldom change."""
read_saved = attrgetter(*SAVED)


class Plant:
    """Time, counters and state of a driven mechanism in a cell; `ArmState` and `Scene` are filled
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
        self._saved: tuple[ArmState, object] | None = None  # last state filled, with these
        self._model = cell.model
        self._data = cell.start()

    def _show(self, scene: Scene) -> None:
        """Fill a `SCENE` from `_data`."""
        data = self._data
        bodies = self.cell.bodies
        tool = self.cell.tool
        mujoco.mj_kinematics(self._model, data)  # after a step, poses are those before it
        scene.position[: len(bodies)] = data.xpos[bodies]
        scene.quaternion[: len(bodies)] = data.xquat[bodies]
        scene.tool_position = data.site_xpos[tool]
        mujoco.mju_mat2Quat(scene.tool_quaternion, data.site_xmat[tool])

    def save(self, state: ArmState) -> None:
        """Fill an `ARM_STATE` with the state that a restarted board needs. Default: the attributes.

        A simulation adds its state: `state.state` has room for it, see `rack.levels.robot.engine`.
        """
        self.report_cycle()
        state.tick = self.tick
        saved = state, read_saved(self)
        if saved != self._saved:
            self._saved = saved
            for name in SAVED:
                setattr(state, name, getattr(self, name))

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

    def complete_cycle(self, state: ArmState | None) -> None:
        """Report a cycle, and fill its `ARM_STATE`, unless the level has saved it."""
        if self._reported_tick != self.tick:
            if state is not None:
                self.save(state)
            self.report_cycle()

    def restore(self, state: ArmState) -> None:
        """Continue from an `ARM_STATE`: called once, before the first `step`, on a restarted
        board.
        """
        self.tick = state.tick
        for name in SAVED:
            setattr(self, name, getattr(state, name))
