"""The system controller: what the board in slot 1 does at every tick besides releasing the tasks.

It lets faults begin and end, gives operators' commands, takes restarted boards up again on the grid, and tells the arm
to stop or brake.
"""

from __future__ import annotations

from rack.backplane.alarms import Alarm
from rack.backplane.clock_driver import ClockDriver
from rack.backplane.released_task import ReleasedTask
from rack.backplane.segment import Segment
from rack.backplane.words import Demand, System
from rack.boards.faults.clock_board import FaultStage
from rack.boards.operating.desk import OperatorDesk
from rack.boards.wiring import ClockWiring

# Plain integers for the hot path.
_LOSSES, _EMERGENCY = int(System.LOSSES), int(System.EMERGENCY_STOP)


class SystemController:
    """Implements `rack.backplane.clock_driver.Controller`."""

    def __init__(self, segment: Segment, wiring: ClockWiring, driver: ClockDriver) -> None:
        self._words, self._wiring, self._driver = segment.words, wiring, driver
        self._faults = FaultStage(segment, driver)
        self._desk = OperatorDesk(segment, driver.alarms)
        self._settled: tuple[int, int, int] | None = None
        self._demand = Demand(self._words[System.DEMAND])

    def begin(self, tick: int) -> None:
        """Do what is due before the tasks of `tick` are released."""
        if not self._faults.is_quiet:
            self._faults.advance(tick)
        if not self._desk.is_quiet:
            self._desk.advance(tick)
        words = self._words
        if self._settled != (words[_LOSSES], self._driver.watchdog.losses, words[_EMERGENCY]):
            self._mind_the_lost(tick)

    def released(self, tick: int) -> None:
        """Do what is due after they were released."""
        self._faults.within(tick)

    def _mind_the_lost(self, tick: int) -> None:
        """Take up who is back, latch for who will not be, and demand of the arm what the others' loss asks for."""
        words = self._words
        seen = words[_LOSSES], self._driver.watchdog.losses
        lost = [task for task in self._driver.tasks if task.lost_tick >= 0]
        for task in lost:
            self._mind(task, tick)
        lost = [task for task in lost if task.lost_tick >= 0]
        self._ask_of_the_arm(lost, tick)
        self._settled = (*seen, words[_EMERGENCY]) if not lost else None

    def _mind(self, task: ReleasedTask, tick: int) -> None:
        lockstep = self._wiring.lockstep
        if lockstep and tick < task.lost_tick + self._wiring.restart_ticks:
            return
        self._driver.await_state(lambda: task.is_ready or task.is_given_up)
        if task.is_ready:
            away = tick - task.lost_tick
            self._driver.settle()
            task.rejoin()
            self._driver.alarms.ring(tick, Alarm.REJOINED, task.index, away)
        elif task.is_given_up:
            # Also where the latch is set already, as it is before the start.
            self._words[_EMERGENCY] = 1
            # The arm comes to rest before the run ends.
            ends = tick + self._wiring.linger
            self._words[System.STOP_TICK] = min(self._words[System.STOP_TICK] or ends, ends)

    def _ask_of_the_arm(self, lost: list[ReleasedTask], tick: int) -> None:
        asked = [(self._wiring.on_loss.get(task.spec.name, Demand.NONE), task.index) for task in lost]
        if self._words[_EMERGENCY]:
            asked.append((Demand.BRAKE, -1))
        demand, subject = max(asked, default=(Demand.NONE, -1))
        if demand != self._demand:
            self._driver.settle()
            self._demand = demand
            self._words[System.DEMAND] = demand
            self._driver.alarms.ring(tick, Alarm.DEMAND, subject, demand)
