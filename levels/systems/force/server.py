"""The executor of a server of force and motion: does a client's requests, and outlives the
client."""

from __future__ import annotations

import numpy as np

from rack.backplane.message import Message
from rack.levels.level import Input, LevelContext, Output, Ports
from rack.levels.messages import Error
from rack.levels.systems.force.messages import (
    COMPLIANCE,
    FORCE_STATUS,
    SERVER_REQUEST,
    SERVER_STATE,
    SERVER_STATUS,
    Mode,
)
from rack.levels.systems.force.work import ServerParams, ServerWork
from rack.levels.systems.force.wrist_level import WristLevel
from rack.levels.systems.trajectory import TrajectoryExecutor
from rack.levels.systems.trajectory.messages import RequestEnd
from rack.levels.tables import read_params


class ForceServer(WristLevel, TrajectoryExecutor):
    """A trajectory level above one of hybrid control, which makes axes of a task frame ones of
    force.

    A client that falls silent while requests are left, or while axes are of force, is lost: its
    requests are CANCELLED, and the arm comes to rest on the axes of motion. Forces are held for
    `hold`, go to zero, and the arm holds where it then is. What comes meanwhile is REFUSED until a
    CANCEL.
    """

    inputs = {
        **TrajectoryExecutor.inputs,
        "requests": Input(SERVER_REQUEST, "above.requests"),
        "force": Input(FORCE_STATUS, "below.force"),
        "last_status": Input(SERVER_STATUS, "own.status"),
        "last_state": Input(SERVER_STATE, "own.state"),
        "last_compliance": Input(COMPLIANCE, "own.compliance"),
    }
    outputs = {
        **TrajectoryExecutor.outputs,
        "status": Output(SERVER_STATUS, rests_on="boards"),
        "state": SERVER_STATE,
        "compliance": COMPLIANCE,
    }
    params = ServerParams
    work = ServerWork
    _work: ServerWork

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._params = read_params(ServerParams, context.params)
        self._work.boards = self._boards
        wrist = context.robot.wrist
        assert wrist is not None, "`misfits` refuses an arm without a sensor"
        self._work.most = wrist.most_force, wrist.most_torque
        self._now = 0  # tick of this cycle
        self._heard = -1  # tick of the client's last sign of life; -1: not yet counted
        self._without = Mode.MOTION  # mode without a client
        self._since = 0  # tick since when
        self._sensed = np.array(context.robot.home)  # (joints,), rad

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Take requests, look at client and contact, go on with the motion."""
        self._now = tick
        if self._heard < 0 or read.requests.is_new:
            self._heard = tick
        super().process(read, write, tick)
        self._work.contact.fill(write.compliance)
        write.compliance.operator = write.command.operator
        self._show(write.status)

    @property
    def mode(self) -> Mode:
        """What the server does."""
        if self._agenda.error is Error.CLIENT:
            return self._without
        return Mode.FORCE if self._work.contact.complies else Mode.MOTION

    def _recall(self, read: Ports) -> None:
        super()._recall(read)
        if read.last_compliance.is_there and read.last_status.is_there:
            self._work.contact.recall(read.last_compliance.value)
            status = read.last_status.value
            self._work.guarded = status.guarded
            self._work.axis = status.axis
            self._without = Mode(status.mode)
            self._since = self._now

    def _follow_boards(self, read: Ports) -> None:
        super()._follow_boards(read)
        for below in read.boards.values():
            if below.is_there:
                self._sensed = below.value.position
        # Take over the newest contact; a guard that was struck ends the request under way.
        status = read.force.value
        work = self._work
        answers = (
            read.force.is_there
            and not read.force.is_lost
            and status.echo == work.contact.id
            and status.sensed >= 0
        )
        work.force = status if answers else None
        if answers and status.struck == work.contact.id and work.contact.guard.any():
            work.strike(int(status.axis))
        self._miss_client()

    def _miss_client(self) -> None:
        """Outlive a client that is lost."""
        work = self._work
        params = self._params
        agenda = self._agenda
        if agenda.error is not Error.CLIENT:
            if self._passed_s(self._heard) > params.silence and (
                agenda.held or work.contact.complies
            ):
                self._work.drop(RequestEnd.CANCELLED, "", Error.CLIENT)
                if self._work.contact.complies:
                    self._enter(Mode.HELD, f"forces are held for {self._params.hold:g} s")
                else:
                    self._enter(Mode.RELEASED, "the position is held")
        elif self._without is Mode.HELD and self._passed_s(self._since) > params.hold:
            work.contact.relax()
            self._enter(Mode.RELEASING, "forces go to zero")
        elif self._without is Mode.RELEASING:
            is_over = self._passed_s(self._since) > params.reach
            if is_over or (work.off() <= 1.0).all():
                work.release()
                self._enter(Mode.RELEASED, "forces released, the position is held")

    def _enter(self, mode: Mode, what: str) -> None:
        self._without = mode
        self._since = self._now
        silent = f"no sign of life from the client for {self._params.silence:g} s"
        self._agenda.reason = f"{silent}: {what}; cancel, then go on"

    def _passed_s(self, tick: int) -> float:
        return (self._now - tick) * self.context.tick_s

    def _show(self, status: Message) -> None:
        """Fill what a server's status says beyond a trajectory level's."""
        work = self._work
        force = work.force
        status.mode = self.mode
        (status.place, status.quaternion) = self._ik.tool_at(self._sensed)
        status.frame = work.contact.frame
        status.selected = work.contact.selected
        status.wanted = work.contact.wrench
        if force is not None:
            status.wrench = -force.wrench
        status.guarded = work.guarded
        status.axis = work.axis
