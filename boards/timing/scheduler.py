"""A simulated core, whose jobs compete for it under their schedulers."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.words import Scheduler
from rack.boards.timing.schedule import simulate_core
from rack.boards.timing.tasks import TURN_NS, Urgency, compute_urgency


@dataclass
class CoreJob:
    """Job that competes for a simulated core.

    Attributes:
        task: Name of the task.
        scheduler: Scheduler of the task.
        priority: Fixed priority of the task.
        is_critical: Whether the task is critical.
        ready_at: Time in ns from which the job can run.
        deadline_ns: Deadline of the job.
        left_ns: Processor time that the job still needs. 0 when it has ended.
        locked_ns: Length of the last part of the job, which runs at priority `ceiling`.
        ceiling: Priority of that part.
        turn_at: Under ordinary scheduling, time at which the job began to wait for its turn.
        turn_ns: Rest of that turn.
        begun_ns: Time at which the job began. -1 if it has not.
    """

    task: str
    scheduler: Scheduler
    priority: int
    is_critical: bool
    ready_at: int
    deadline_ns: int
    left_ns: int
    locked_ns: int = 0
    ceiling: int = 0
    turn_at: int = -1
    turn_ns: int = TURN_NS
    begun_ns: int = -1

    def get_urgency(self, now_ns: int) -> Urgency:
        """Return its urgency at a time. Of equal jobs, the one released first runs."""
        is_locked = self.left_ns < self.locked_ns
        urgency = compute_urgency(
            self.scheduler,
            max(self.priority, self.ceiling) if is_locked else self.priority,
            self.deadline_ns,
            self.deadline_ns - now_ns - self.left_ns,
            is_critical=self.is_critical,
        )
        return *urgency, not is_locked, max(self.ready_at, self.turn_at), self.task

    def run_step(self, now_ns: int, until_ns: int) -> int:
        """Run the job until it ends or its turn or the time is over, and return the end in ns."""
        if self.begun_ns < 0:
            self.begun_ns = now_ns
        end = min(now_ns + self.left_ns, until_ns)
        if not self.priority:
            end = min(end, now_ns + self.turn_ns)
            self.turn_ns -= end - now_ns
            if not self.turn_ns:
                self.turn_at, self.turn_ns = end, TURN_NS
        self.left_ns -= end - now_ns
        return end


class SimulatedCore:
    """A core whose jobs become known while time advances.

    Attributes:
        jobs: Jobs that have not ended.
        now_ns: Time up to which the core has been simulated.
    """

    def __init__(self, now_ns: int = 0) -> None:
        self.jobs: list[CoreJob] = []
        self.now_ns = now_ns

    def run_until(self, until_ns: int) -> CoreJob | None:
        """Simulate the core until a job ends, and return the job. None if no job ends in time."""
        for now_ns, job in simulate_core(self.jobs, self.now_ns, until_ns):
            if not job.left_ns:
                self.now_ns = now_ns
                self.jobs.remove(job)
                return job
        self.now_ns = until_ns
        return None
