"""A client of a server of force and motion, on the host side: its calls, besides those of
`Motions`.

    comply("wipe")                what follows is done with the axes of force of [task.contact.wipe]
    comply("wipe", wrench={"z": 20.0})       the same with another force
    guard("touch")                the next of its wrenches ends the motion under way
    free()                        motion alone, without guards
    wrench(), mode()              of the tool on the surroundings, N, N m, by axis; what the
                                  server does

A guard that ends a request ends itself with it: `end_of(request)` is GUARDED. Calls that wait give
the server its sign of life; a program that makes none for longer than the server's `silence` is
lost to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from rack.levels.errors import LevelError
from rack.levels.host_program import Bus
from rack.levels.level import Input, LevelContext
from rack.levels.systems.force.contact import AXIS_NAMES, Wanted
from rack.levels.systems.force.messages import SERVER_REQUEST, SERVER_STATUS, Mode
from rack.levels.systems.force.program import ContactConfig, ForceProgram
from rack.levels.systems.trajectory.commands import CommandEnvironment, Motions
from rack.levels.systems.trajectory.messages import MotionKind

SIGN_S = 0.1
"""Simulated time between signs of life."""


class ForceMotions(Motions):
    """Requests for forces and motions as calls. A call raises `LevelError` at once for a contact
    that is impossible."""

    calls = (*Motions.calls, "comply", "guard", "free", "wrench", "mode")

    def __init__(self, bus: Bus, context: LevelContext) -> None:
        self._program = ForceProgram.model_validate(dict(context.task))
        self._sign_ticks = round(SIGN_S / context.tick_s)
        self._signed = bus.tick  # tick of the last sign of life
        super().__init__(bus, context.robot, context.scene)

    def comply(self, contact: str, **changes: Any) -> int:
        """Make axes ones of force, at rest; done when their forces are as wanted."""
        wanted = self._wanted("comply", contact, changes)
        if not wanted.selected.any():
            raise LevelError(
                f"comply: contact '{contact}' has no axis of force; free() ends compliance"
            )
        fields = wanted._asdict()
        del fields["guard"]
        return self._request(kind=MotionKind.COMPLY, **fields)

    def guard(self, contact: str, **changes: Any) -> int:
        """Guard axes: the next wrench beyond a limit ends the motion under way."""
        wanted = self._wanted("guard", contact, changes)
        if not wanted.guard.any():
            raise LevelError(f"guard: contact '{contact}' guards no axis")
        return self._request(kind=MotionKind.GUARD, frame=wanted.frame, guard=wanted.guard)

    def free(self) -> int:
        """End compliance and guards; done when the arm rests where it is."""
        return self._request(kind=MotionKind.COMPLY)

    def wrench(self) -> Mapping[str, float]:
        """Return the wrench of the tool on the surroundings, N, N m, by axis of the task frame."""
        values = self._bus.read("motion").value.wrench
        return {
            name: round(float(value), 3) for name, value in zip(AXIS_NAMES, values, strict=True)
        }

    def mode(self) -> Mode:
        """Return what the server does."""
        return Mode(self._bus.read("motion").value.mode)

    def where(self) -> list[float]:
        """Return the tool position as sensed, m."""
        return [round(float(x), 4) for x in self._bus.read("motion").value.place]

    def _wanted(self, call: str, name: str, changes: Mapping[str, Any]) -> Wanted:
        """Return a contact of the program, with changes. Raises `LevelError`."""
        contact = self._program.contact.get(name)
        if contact is None:
            known = ", ".join(self._program.contact) or "none"
            raise LevelError(
                f"{call}: contact '{name}' is not in [task.contact]; permitted: {known}"
            )
        try:
            changed = ContactConfig(**{**contact.model_dump(), **changes})
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            raise LevelError(
                f"{call}: {key} = {first['input']!r}: {first['msg'].lower()}"
            ) from error
        if reason := self._program.objection(changed, self._robot):
            raise LevelError(f"{call}: contact '{name}': {reason}")
        return self._program.wanted(changed)

    def _look(self) -> None:
        if self._bus.tick - self._signed >= self._sign_ticks:
            self._signed = self._bus.tick
            self._bus.send("requests", id=0)
        super()._look()


class ForceClient(CommandEnvironment):
    """Runs a script that commands forces and motions by name; a prompt offers the same names."""

    inputs = {"motion": Input(SERVER_STATUS, "below.motion")}
    outputs = {"requests": SERVER_REQUEST}
    program = ForceProgram

    def motions(self, bus: Bus) -> Motions:
        """Return what makes requests of calls."""
        return ForceMotions(bus, self.context)
