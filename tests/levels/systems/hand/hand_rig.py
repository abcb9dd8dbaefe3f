"""A hand driven by test boards, which hold its joints at positions like a joint loop."""

from __future__ import annotations

from typing import cast

import numpy as np

from rack.backplane.message import Message
from rack.levels.level import Executor, Input, LevelContext, Output
from rack.levels.robot.cell import build_cell
from rack.levels.systems.hand.executor import HandExecutor
from rack.levels.systems.hand.messages import EXTENSOR, FLEXOR, HandStatus, TensionCommand
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep

CLOCK_NS = 500_000
EVERY = 4
STIFFNESS, DAMPING = 2.0, 0.06
"""Of a joint, N m/rad and N m s/rad."""
AMPLITUDE_RAD, RATE = 0.15, 6.0
"""Of the swing of every joint about home, and its frequency, rad/s."""


class Swing(Executor):
    """Swings the joints of the finger `finger`, or of all."""

    below = Input(HandStatus, "below.status")
    before = Input(TensionCommand, "own.command")
    command = Output(TensionCommand)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        hand = build_cell(context.robot, context.scene, context.clock_ns).hand
        assert hand is not None
        self.hand = hand
        finger = context.params.get("finger")
        everything = np.ones(len(hand.arms), bool)
        self.driven = everything if finger is None else hand.fingers[hand.names.index(finger)]
        self.override: float | None = None  # N: commanded of all tendons instead

    def process(self, tick: int) -> None:
        status, command, hand = self.below.message, self.command, self.hand
        if not self.below.has_message:
            command.sampled = -1
            return
        swing = AMPLITUDE_RAD * np.sin(RATE * tick * self.context.tick_s)
        wanted = np.array(self.context.robot.home) + swing
        torque = STIFFNESS * (wanted - status.position) - DAMPING * status.velocity
        tension = np.zeros((2, len(torque)))
        half = torque / (2 * hand.arms)
        tension[FLEXOR], tension[EXTENSOR] = hand.rest + half, hand.rest - half
        within = np.clip(tension, hand.least, hand.most)
        command.tension = within if self.override is None else self.override
        command.driven, command.sampled = self.driven, status.tick


class HandRig(Lockstep):
    """A hand and the boards that swing its fingers: one for each of `fingers`, or one for all."""

    def __init__(self, fingers: tuple[str, ...] = ()) -> None:
        robot, scene = config("utah_mit")
        above = tuple(fingers) or ("all",)
        finger = {name: {"finger": name} if fingers else {} for name in above}
        boards = [BoardSpec("hand", EVERY, HandExecutor, above=above)]
        boards += [BoardSpec(n, EVERY, Swing, below="hand", params=finger[n]) for n in above]
        super().__init__(boards, robot, scene, clock_ns=CLOCK_NS)

    @property
    def executor(self) -> HandExecutor:
        return cast(HandExecutor, self.tasks["hand"].level)

    def swing(self, board: str = "all") -> Swing:
        return cast(Swing, self.tasks[board].level)

    @property
    def status(self) -> Message:
        """The newest status that is visible."""
        return self.read("hand.status")

    def cycles(self, count: int) -> None:
        self.run(count * EVERY * CLOCK_NS * 1e-9)
