"""Servo level of an arm that shares objects with the arms of other racks."""

from __future__ import annotations

from pydantic import Field, field_validator

from rack.levels.arm import find_arm
from rack.levels.level import Input, Inputs, LevelContext, Mismatches, Output
from rack.levels.servo.control import ServoParams
from rack.levels.servo.law import ServoExecutor
from rack.levels.systems.coordination.shared_bodies import (
    MAX_SHARED,
    NAME_BYTES,
    SharedBodies,
    SharedBody,
)
from rack.levels.systems.coordination.sharing_arm import SharingArm

SHARED = Output(SharedBodies, cycles=8)
"""With a clock of 400 Hz this is 50 Hz, the fastest exchange between racks."""


class SharingServoParams(ServoParams):
    """`[board.servo.params]` of a servo level that shares objects."""

    shared: tuple[str, ...] = Field(min_length=1, max_length=MAX_SHARED)
    """objects of the scene that arms of other racks move too"""
    arm: str = "rack.levels.systems.coordination.sharing_arm:SharingArm"
    """class of the arm, package.module:Class; a SharingArm"""

    @field_validator("arm")
    @classmethod
    def _check_arm(cls, reference: str) -> str:
        """Check that the class of the arm is `SharingArm` or a subclass."""
        if not issubclass(find_arm(reference), SharingArm):
            raise ValueError(
                "this arm cannot share objects; it must be"
                " rack.levels.systems.coordination.sharing_arm:SharingArm or a subclass"
            )
        return reference


class SharingServoExecutor(ServoExecutor):
    """Servo level that claims the shared objects that its gripper touches.

    It fixes its own copies of objects that other racks move.

    After a restart of its board it continues from its own last message. See `SharedBody`.
    """

    others = Inputs(SharedBodies, "lan.shared")
    last = Input(SharedBodies, "own.shared")
    shared = SHARED
    params = SharingServoParams
    settings: SharingServoParams
    arm: SharingArm

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        names = self.settings.shared
        rack = context.rack.encode()
        self._shared = {
            context.scene.objects.index(name): SharedBody(name.encode(), rack) for name in names
        }

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield the mistakes in the list of shared objects and in the rest of the servo level."""
        names = context.params["shared"]
        scene = context.scene
        for name in dict.fromkeys(names):
            why = ""
            if name not in scene.objects:
                why = "is not in the scene"
                if name in scene.obstacles:
                    why = "is an obstacle, which moves by itself"
                why += f"; valid objects: {', '.join(scene.objects) or 'none'}"
            elif names.count(name) > 1:
                why = "is named more than once"
            elif len(name) > NAME_BYTES or not name.isascii():
                why = f"does not fit into a message: at most {NAME_BYTES} ASCII characters"
            if why:
                yield "params.shared", name, why
        yield from super().find_mismatches(context)

    def process(self, tick: int) -> None:
        """Run a cycle of a servo level, and write the shared objects if they are due."""
        if not self.enabling.is_started and self.last.has_message:
            for body in self._shared.values():
                body.restore_state(self.last.message)
        super().process(tick)
        if SHARED.is_due(tick, self.context.every, self.context.phase):
            self.shared.rack = self.context.rack
            for slot, (row, body) in enumerate(self._shared.items()):
                body.write_entry(self.shared.bodies[slot], self.arm.read_pose(row))

    def on_restored(self) -> None:
        """Keep the grip, and fix the copies at their restored poses."""
        super().on_restored()
        self._fix_copies()

    def take_messages(self) -> None:
        """Read new messages, including those of other racks, and update claims and copies."""
        super().take_messages()
        for row, body in self._shared.items():
            for other in self.others.values():
                if other.is_new and (pose := body.process_message(other.message)) is not None:
                    self.arm.place_object(row, pose)
            body.update_touch(self.arm.is_touched(row))
        self._fix_copies()

    def _fix_copies(self) -> None:
        """Fix the copies of objects that other racks move, and release the rest."""
        for row, body in self._shared.items():
            self.arm.fix_object(row, body.is_moved_elsewhere)
