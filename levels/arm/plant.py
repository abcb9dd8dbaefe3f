"""Base class of an arm or hand that a board drives: time, counters and messages."""

from __future__ import annotations

from operator import attrgetter

import mujoco

from rack.backplane.watch.alarms import Alarm
from rack.levels.level import Executor, Finding
from rack.levels.messages import ArmState, Error, Scene
from rack.levels.robot.cell import Cell

EPISODE_TICKS = 20
"""Ticks without a finding of one kind after which the next finding begins a new episode."""
SAVED_ATTRIBUTES = ("waited", "braked", "clipped", "touches", "violations", "pushed", "struck")
"""Attributes of a plant that its `ArmState` contains, and that seldom change."""
read_saved = attrgetter(*SAVED_ATTRIBUTES)


class Plant:
    """Time, counters and state of a driven mechanism in a cell.

    It fills `ArmState` and `Scene` messages. It shares the list `findings` with the executor that
    constructs it. The board therefore receives its findings, and the `ArmState` its counters, even
    if the level itself reports nothing.
    """

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.findings: list[Finding] = []  # once per episode
        if Executor.last_constructed is not None:
            self.findings = Executor.last_constructed.findings
            Executor.last_constructed.complete_cycle.append(self.complete_cycle)
        self._found_ticks: dict[Alarm, int] = {}  # tick of the last finding of each kind
        self._reported_tick = -1  # tick of the last cycle that was reported
        self.tick = 0  # present tick
        self.late_s = 0.0  # s: time by which the clock is late for the present cycle
        self.waited = 0  # ticks since the last command
        # True while it is held without commands: by the brakes of an arm, or the valves of a hand.
        self.braked = True
        self.fault = ""  # why it has failed and cannot move. Empty if it has not
        self.clipped = 0  # cycles in which a command was refused or cut
        self.brake_cause: int = Error.NONE  # cause if brakes engage in this cycle
        # Geoms of an unintended contact of the mechanism or its load in a step.
        self.contact: tuple[int, int] | None = None
        self.touches = 0  # unintended contacts so far
        self.first_touch = ""  # description of the first unintended contact
        # Steps in which the drives broke a limit of position, velocity or torque.
        self.violations = 0
        self.struck = 0  # ticks for which motion is still attributed to a contact
        # Steps in which an unintended contact pushed a joint beyond a position or velocity limit.
        self.pushed = 0
        self.first_violation = ""  # description of the first violation
        self._saved: tuple[ArmState, object] | None = None  # last state filled, and its values
        self._model = cell.model
        self._data = cell.build_start_data()

    def _fill_scene(self, scene: Scene) -> None:
        """Fill a `Scene` with the poses of bodies and tool in `_data`."""
        data = self._data
        bodies = self.cell.bodies
        tool = self.cell.tool
        # After a step, MuJoCo's poses are still the poses before the step.
        mujoco.mj_kinematics(self._model, data)
        scene.position[: len(bodies)] = data.xpos[bodies]
        scene.quaternion[: len(bodies)] = data.xquat[bodies]
        scene.tool_position = data.site_xpos[tool]
        mujoco.mju_mat2Quat(scene.tool_quaternion, data.site_xmat[tool])

    def save(self, state: ArmState) -> None:
        """Fill an `ArmState` with the state that a restarted board needs.

        By default, this state consists of the attributes in `SAVED_ATTRIBUTES`. A simulation also
        fills `state.state`, see `rack.levels.robot.engine`.
        """
        self.report_cycle()
        state.tick = self.tick
        saved = state, read_saved(self)
        if saved != self._saved:
            self._saved = saved
            for name in SAVED_ATTRIBUTES:
                setattr(state, name, getattr(self, name))

    def report_finding(self, finding: Finding) -> None:
        """Report a finding, unless it continues an episode of the same alarm."""
        last = self._found_ticks.get(finding.alarm)
        if last is None or self.tick - last > EPISODE_TICKS:
            self.findings.append(finding)
        self._found_ticks[finding.alarm] = self.tick

    def refuse_command(self, finding: Finding) -> Finding:
        """Count and report a refused command; return the finding."""
        self.clipped += 1
        self.report_finding(finding)
        self.brake_cause = Error.LIMIT
        return finding

    def report_cycle(self) -> None:
        """Report the events of the cycle. Called at the end of the cycle."""
        self._reported_tick = self.tick

    def complete_cycle(self, state: ArmState | None) -> None:
        """Report a cycle and fill its `ArmState`, unless the level has already done both.

        `state` is None if the level publishes no `ArmState`.
        """
        if self._reported_tick != self.tick:
            if state is not None:
                self.save(state)
            self.report_cycle()

    def restore(self, state: ArmState) -> None:
        """Continue from an `ArmState`.

        Called once on a restarted board, before the first `step`.
        """
        self.tick = state.tick
        for name in SAVED_ATTRIBUTES:
            setattr(self, name, getattr(state, name))
