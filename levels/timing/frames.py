"""Static cyclic schedules: every board has its place in minor frames, which repeat with the major
frame.

The terms are those of T. P. Baker and A. Shaw, *The Cyclic Executive Model and Ada*, Real-Time
Systems 1 (1989). A board's cycle is a whole number of minor frames and divides the major one; its
phase is its place in them. Boards whose places are in one tick follow each other by priority.
Planners have no place: they plan in the slack.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

from rack.levels.timing.rack import RackTiming
from rack.levels.timing.response_time import job_ns
from rack.levels.timing.schedule import Span, simulate
from rack.levels.timing.tasks import Part, TimedTask, Unit

Work = dict[tuple[str, int], list[Span]]
"""The stretches of work of every job, in order, by task and release."""


@dataclass(frozen=True)
class FramePlace:
    """A board in a frame, ns from the frame's start: it begins at `offset_ns` and must be done by
    `limit_ns`.

    `job_ns` is its budget with two context switches. `slack_ns` is the time from its end to the
    limit; negative: so much of its work is left then, if the limit stops nothing. `until` is the
    board that begins at the limit; empty: the frame ends there.
    """

    board: str
    offset_ns: int
    job_ns: int
    limit_ns: int
    slack_ns: int
    until: str


@dataclass(frozen=True)
class CoreFrames:
    """Frames of one core, by number in the major frame, in which the same boards have the same
    places."""

    core: int
    frames: tuple[int, ...]
    places: tuple[FramePlace, ...]

    def document(self) -> dict[str, Any]:
        """Return it as plain data; times are ms."""
        names = ("offset", "job", "limit", "slack")
        places = [
            {
                "board": p.board,
                "until": p.until,
                **{f"{n}_ms": getattr(p, f"{n}_ns") * 1e-6 for n in names},
            }
            for p in self.places
        ]
        return {"core": self.core, "frames": list(self.frames), "places": places}


def core_frames(rack: RackTiming) -> tuple[CoreFrames, ...]:
    """Return the distinct frames of every core, in the order of their first; none without a static
    schedule.

    They are those of the second major frame: boards that are late in the first have their effect
    there.
    """
    if rack.schedule is None:
        return ()
    minor, major = (ticks * rack.tick_ns for ticks in rack.schedule)
    # A job with its switches is one stretch of work.
    tasks = [
        replace(task, parts=(Part(Unit.PROCESS, job_ns(task, rack.context_switch_ns)),))
        for task in rack.tasks
        if task.role != "planner"
    ]
    work: Work = defaultdict(list)
    for span in simulate(tasks, 2 * major + 2 * minor).spans:
        work[span.task, span.release_ns].append(span)
    found: dict[tuple[int, tuple[FramePlace, ...]], list[int]] = defaultdict(list)
    for core in sorted({task.core for task in tasks if task.role == "executor"}):
        own = [task for task in tasks if task.core == core and task.role == "executor"]
        for frame in range(major // minor):
            if places := tuple(_places(own, work, major + frame * minor, minor)):
                found[core, places].append(frame)
    return tuple(
        CoreFrames(core, tuple(frames), places) for (core, places), frames in found.items()
    )


def _places(tasks: Sequence[TimedTask], work: Work, start: int, minor: int) -> Iterator[FramePlace]:
    """Yield the places of a frame that begins at `start`, of the tasks of one core."""
    released = [
        (start + (task.phase_ns - start) % task.every_ns, -task.priority, task.name, task)
        for task in tasks
        if (task.phase_ns - start) % task.every_ns < minor
    ]
    groups = [
        [task for *_, task in group]
        for _, group in groupby(sorted(released), key=lambda one: one[0])
    ]
    times = [*sorted({release for release, *_ in released}), start + minor]
    for group, release, following, limit in zip(
        groups, times, [*groups[1:], []], times[1:], strict=False
    ):
        begins = release
        for task, after in zip(group, [*group[1:], *following, None], strict=False):
            is_last = task is group[-1]
            end, done = _worked(work[task.name, release], task, limit)
            slack_ns = 0
            if end is None:
                slack_ns = done - task.cost_ns
            elif is_last:
                slack_ns = limit - end
            ends_by = limit if is_last or end is None else end
            until = "" if after is None else after.name
            yield FramePlace(
                board=task.name,
                offset_ns=begins - start,
                job_ns=task.cost_ns,
                limit_ns=ends_by - start,
                slack_ns=slack_ns,
                until=until,
            )
            begins = limit if end is None else end


def _worked(spans: Sequence[Span], task: TimedTask, limit: int) -> tuple[int | None, int]:
    """Return the end of a job if it is not after `limit`, and its processor time until then."""
    done = sum(min(span.end_ns, limit) - span.start_ns for span in spans if span.start_ns < limit)
    end = spans[-1].end_ns if done == task.cost_ns else None
    return end, done
