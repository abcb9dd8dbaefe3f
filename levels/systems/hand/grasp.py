"""The grasp loop: executes a program of steps that begins and ends with an open hand."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rack.backplane.message import State
from rack.levels.algebra import Array
from rack.levels.errors import Refused
from rack.levels.level import (
    OPERATOR,
    Executor,
    Input,
    Inputs,
    LevelContext,
    Mismatches,
    Output,
    Reading,
)
from rack.levels.messages import Error, WorldState
from rack.levels.operator import HOLD_COMMANDS
from rack.levels.planning.pose import Pose
from rack.levels.robot.cell import build_level_cell
from rack.levels.systems.hand.grasp_program import (
    CloseStep,
    GraspProgram,
    Posture,
    PreshapeStep,
    ShiftStep,
    SqueezeStep,
    Step,
)
from rack.levels.systems.hand.grasp_steps import WORKS, FingersBelow, Grasp, GraspParams, StepWork
from rack.levels.systems.hand.grip import HandGrip
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.messages import (
    FingerStatus,
    GraspKind,
    GraspPlan,
    GraspStatus,
    GraspTarget,
    HostWords,
)

N_PER_MN = 1e-3
PLANNED = "planned"
"""Name of the posture that a plan defines."""
NO_WORLD = "no world model: waiting for where the object is"
NO_PLAN = "no plan of the grasp yet: waiting for one from '{}'"


class GraspExecutor(Executor):
    """Executes the steps of a program in order.

    The current step is suspended while a finger does not follow and during an operator's hold; the
    fingers keep their targets and forces in the meantime. A step that fails or is suspended for too
    long ends the program with an error, and the fingers stay as they are. With a planner above, the
    newest plan defines the posture before a CLOSE step, the target points of that step, and the
    grip force after it. A workstation above may add to the grip force. After a restart the level
    continues from its own last messages.
    """

    fingers = Inputs(FingerStatus, "below.status")
    world = Input(WorldState, "world.model")
    plan = Inputs(GraspPlan, "above.plan", optional=True)
    words = Inputs(HostWords, "above.words", optional=True)
    last_command = Input(GraspTarget, "own.command")
    last_status = Input(GraspStatus, "own.status")
    operator = OPERATOR
    command = Output(GraspTarget, rests_on=fingers)
    status = Output(GraspStatus, rests_on=fingers)
    commands = HOLD_COMMANDS
    params = GraspParams
    settings: GraspParams
    program = GraspProgram

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        cell = build_level_cell(context)
        assert cell.hand is not None, "checked with the config"
        self._program = GraspProgram.model_validate(dict(context.task))
        kinematics = FingerKinematics(cell, cell.hand)
        self._from_world = kinematics.palm.inverse()  # pose of the world in the frame of the palm
        names = cell.hand.names
        params = self.settings
        self._opposing = names.index(self._program.opposing)
        self._grasp = Grasp(
            params=params,
            names=names,
            joints=context.robot.joints,
            postures={
                name: self._join_posture(posture) for name, posture in self._program.posture.items()
            },
            period_s=context.period_s,
            fingers=FingersBelow(context, kinematics.joints),
            target=GraspTarget.zeros(context.sizes),
            grip=HandGrip(params, np.full(len(names), False), self._opposing, context.period_s),
            touching=np.full(len(names), False),
        )
        self._work: StepWork | None = None  # the current step, once it has begun
        self._done = 0  # number of completed steps
        self._elapsed_s = 0.0  # execution time of the current step, without suspensions
        self._waited_s = 0.0  # duration of the current suspension, except holds of an operator
        self._failed = Refused(Error.NONE, "")
        self._plan = GraspPlan.zeros(context.sizes)  # plan in use, id 0 without one
        self._started = False  # whether the first cycle has begun

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Report a missing hand, fingers not driven by exactly one board, or a missing planner."""
        hand = context.robot.hand
        if hand is None:
            yield "executor", cls.__name__, "it drives a hand, but there is no [robot.hand]"
            return
        names = [finger.name for finger in hand.finger]
        for name in names:
            boards = [
                board
                for board, pace in context.below.items()
                if pace.params.get("finger", name) == name
            ]
            if len(boards) != 1:
                by = ", ".join(f"'{board}'" for board in boards) or "none"
                yield (
                    "below",
                    list(context.below),
                    f"finger '{name}' needs one board that drives it; it has: {by}",
                )
        steps = GraspProgram.model_validate(dict(context.task)).step
        if not context.above and any(
            isinstance(step, CloseStep) and not step.points for step in steps
        ):
            yield "above", [], "a step 'close' without points needs a planner of grasps there"

    def process(self, tick: int) -> None:
        """Read fingers and object, continue the current step, and write targets and status."""
        grasp = self._grasp
        self._orders.take_commands(self.operator)
        grasp.fingers.read_statuses(self.fingers)
        for reading in self.words.values():
            added_n = float(reading.message.word[0]) * N_PER_MN
            grasp.added = min(max(added_n, -grasp.params.most_added), grasp.params.most_added)
        if self.world.message.revision:
            # Find the object in the world model.
            close = self._find_close_step()
            if close is not None:
                row = self._find_row(close)
                self._grasp.object = self._from_world @ Pose(
                    self.world.message.position[row], self.world.message.quaternion[row]
                )
        if not self._started:
            self._started = True
            self._restore_progress()
        waits = self._find_waiting_reason()
        # Fail if the program has been suspended for too long.
        is_over = self._done == len(self._program.step) or self._orders.is_holding
        self._waited_s = self._waited_s + self.context.period_s if waits and not is_over else 0.0
        if self._waited_s > self.settings.stalled and not self._failed.code:
            self._failed = Refused(
                Error.STALLED, f"waited for {self.settings.stalled:g} s: {waits}"
            )
        if not waits and not self._failed.code and self._done < len(self._program.step):
            self._run_step()
        if waits or self._failed.code:
            grasp.target.velocity[:] = grasp.target.tip_velocity[:] = 0.0
        grasp.target.id += 1
        grasp.target.operator = self._orders.basis
        self.command.copy_from(grasp.target)
        self._fill_status(self.status, waits)

    def _find_row(self, close: CloseStep) -> int:
        """Return the index of a CLOSE step's object in the world model."""
        return self.context.scene.objects.index(close.object)

    def _join_posture(self, posture: Posture) -> Array:
        """Convert a posture from positions per finger to joint positions, (joints,), in rad."""
        hand = self.context.robot.hand
        joints = self.context.robot.joints
        assert hand is not None
        position = np.zeros(len(joints))
        for finger in hand.finger:
            position[[joints.index(joint) for joint in finger.joints]] = posture[finger.name]
        return position

    def _find_close_step(self) -> CloseStep | None:
        """Return the newest CLOSE step that has begun, or None if none has."""
        steps = self._program.step[: self._done + 1]
        return next((step for step in reversed(steps) if isinstance(step, CloseStep)), None)

    def _find_waiting_reason(self) -> str:
        """Return why the current step is suspended, or an empty string if it is not."""
        if self._grasp.fingers.awaited:
            return self._grasp.fingers.awaited
        if self._orders.is_holding:
            self._orders.report_done()
            return self._orders.format_reason(self.context.board)
        if self.world.is_lost or (
            self._find_close_step() is not None and self._grasp.object is None
        ):
            return NO_WORLD
        if self.plan and not self._find_newest_plan(self.plan).id and self._needs_plan():
            return NO_PLAN.format(", ".join(self.plan))
        return ""

    @staticmethod
    def _find_newest_plan(plans: Mapping[str, Reading[GraspPlan]]) -> GraspPlan:
        """Return the plan with the highest id."""
        return max((reading.message for reading in plans.values()), key=lambda plan: plan.id)

    def _needs_plan(self) -> bool:
        """Return True if the current step takes its parameters from a plan.

        This applies to a CLOSE step and to a PRESHAPE step directly before one.
        """
        kinds = [type(step) for step in self._program.step[self._done : self._done + 2]]
        return kinds[:1] == [CloseStep] or kinds == [PreshapeStep, CloseStep]

    def _run_step(self) -> None:
        """Begin or continue the current step."""
        if self._work is None:
            if self.plan and self._needs_plan() and not self._elapsed_s:
                self._plan.copy_from(self._find_newest_plan(self.plan))
            self._begin_step()
        assert self._work is not None
        try:
            done = self._work.run(self._elapsed_s)
        except Refused as failure:
            self._failed = failure
            return
        self._elapsed_s += self.context.period_s
        if done:
            self._work = None
            self._elapsed_s = 0.0
            self._done += 1

    def _begin_step(self) -> None:
        """Begin the current step, for the first time or after a restart."""
        grasp = self._grasp
        step = self._prepare_step(self._done)
        if isinstance(step, CloseStep):
            self._adopt_close_step(step)
            if not self._elapsed_s:
                grasp.touching[:] = False
        grasp.target.active = True
        self._work = WORKS[type(step)](grasp, step, self._elapsed_s)

    def _adopt_close_step(self, close: CloseStep) -> None:
        """Make `close` the current CLOSE step and build the grip for its fingers."""
        grasp = self._grasp
        gripping = np.array([name in close.points for name in grasp.names])
        grasp.close = close
        grasp.base = 0.0
        grasp.grip = HandGrip(grasp.params, gripping, self._opposing, self.context.period_s)

    def _prepare_step(self, index: int) -> Step:
        """Return a step to execute, with the plan's values and displacements in the palm frame."""
        step = self._program.step[index]
        plan = self._plan
        if isinstance(step, ShiftStep):
            return step.model_copy(update={"by": tuple(self._from_world.rotate_vector(step.by))})
        if not plan.id:
            return step
        if isinstance(step, CloseStep):
            inside = plan.contact + step.depth * plan.normal
            points = {
                name: tuple(point) for name, point in zip(self._grasp.names, inside, strict=True)
            }
            return step.model_copy(update={"points": points})
        after = self._program.step[index - 1] if isinstance(step, SqueezeStep) else None
        if isinstance(after, CloseStep):
            return step.model_copy(update={"grip": plan.grip})
        if isinstance(step, PreshapeStep) and self._needs_plan():
            self._grasp.postures[PLANNED] = plan.posture.copy()
            return step.model_copy(update={"posture": PLANNED})
        return step

    def _restore_progress(self) -> None:
        """Restore the progress of the program from the level's last messages after a restart."""
        if not (self.last_status.has_message and self.last_command.has_message):
            return
        status = self.last_status.message
        grasp = self._grasp
        grasp.target.copy_from(self.last_command.message)
        self._done = status.step
        self._elapsed_s = status.passed
        if status.plan and self.plan:
            self._plan.copy_from(self._find_newest_plan(self.plan))
        for index in range(min(self._done + 1, len(self._program.step))):
            step = self._prepare_step(index)
            if isinstance(step, CloseStep):
                self._adopt_close_step(step)
            elif isinstance(step, SqueezeStep):
                grasp.base = step.grip if index < self._done else status.grip
        grasp.grip.force = status.grip
        grasp.grip.load[:] = status.load
        grasp.touching[:] = status.touching
        grasp.anchor[:] = status.anchor
        grasp.moved = status.moved
        grasp.farthest = status.farthest
        if status.state == State.ERROR:
            self._failed = Refused(status.error, status.reason)

    def _fill_status(self, status: GraspStatus, waits: str) -> None:
        """Fill the status. `waits` is the reason why the step is suspended, empty if it is not."""
        grasp = self._grasp
        steps = self._program.step
        status.echo = grasp.target.id
        status.step = self._done
        status.steps = len(steps)
        status.kind = GraspKind.NONE
        if self._work is not None:
            status.kind = GraspKind[self._work.step.do.upper()]
        status.passed = self._elapsed_s
        status.touching = grasp.touching
        status.grip = grasp.grip.force
        status.object = -1 if grasp.close is None else self._find_row(grasp.close)
        status.load = grasp.grip.load
        status.anchor = grasp.anchor
        status.plan = self._plan.id
        status.moved = grasp.moved
        status.farthest = grasp.farthest
        status.error = self._failed.code or grasp.fingers.error
        status.reason = str(self._failed) or waits
        if status.error:
            status.state = State.ERROR
        elif self._done == len(steps):
            status.state = State.DONE if steps else State.IDLE
        else:
            status.state = State.HOLDING if waits else State.EXECUTING
        self._orders.fill_status(status, grasp.fingers.rests_on)
