"""Static cyclic schedules: when each board runs in the minor frames of a major frame.

The terms are from T. P. Baker and A. Shaw, *The Cyclic Executive Model and Ada*, Real-Time
Systems 1 (1989). A board's cycle is a whole number of minor frames and divides the major frame. Its
phase is its position in them. Boards with the same position run in the order of their priorities.
Planners have no position and run in the slack.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from rack.boards.timing.rack import RackTiming
from rack.boards.timing.response_time import merge_parts
from rack.boards.timing.schedule import Span, simulate_schedule
from rack.boards.timing.tasks import TimedTask

Work = dict[tuple[str, int], list[Span]]
"""Spans of every job, sorted by time, keyed by the job's task and its release time in ns."""


@dataclass(frozen=True)
class FramePlace:
    """Interval in which a board runs in a minor frame, in ns from the start of the frame.

    Attributes:
        board: The board.
        offset_ns: Time at which its job begins.
        job_ns: Budget of the job with two context switches.
        limit_ns: Time by which the job must end.
        slack_ns: Time from the end of the job to the limit. If the job has not ended by the limit,
            minus the processor time that it still needs.
        until: Board whose job begins at the limit. Empty if the frame ends at the limit.
    """

    board: str
    offset_ns: int
    job_ns: int
    limit_ns: int
    slack_ns: int
    until: str


@dataclass(frozen=True)
class CoreFrames:
    """Equal minor frames of one core, in which the same boards run at the same times.

    Attributes:
        core: The core.
        frames: Numbers of these minor frames within the major frame.
        places: Intervals in which the boards run in each of these frames.
    """

    core: int
    frames: tuple[int, ...]
    places: tuple[FramePlace, ...]

    def to_document(self) -> dict[str, Any]:
        """Return the frames as plain data for JSON. Times are in ms."""
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


def compute_core_frames(rack: RackTiming) -> tuple[CoreFrames, ...]:
    """Return the distinct minor frames of each core. Empty without a static schedule.

    They are taken from the second major frame, which shows the effect of boards that are late in
    the first one.
    """
    if rack.schedule is None:
        return ()
    minor, major = (ticks * rack.tick_ns for ticks in rack.schedule)
    tasks = [
        merge_parts(task, rack.context_switch_ns) for task in rack.tasks if task.role != "planner"
    ]
    work: Work = defaultdict(list)
    for span in simulate_schedule(tasks, 2 * major + 2 * minor).spans:
        work[span.task, span.release_ns].append(span)
    distinct: dict[tuple[int, tuple[FramePlace, ...]], list[int]] = defaultdict(list)
    for core in sorted({task.core for task in tasks if task.role == "executor"}):
        executors = [task for task in tasks if task.core == core and task.role == "executor"]
        for frame in range(major // minor):
            if places := tuple(_list_places(executors, work, major + frame * minor, minor)):
                distinct[core, places].append(frame)
    return tuple(
        CoreFrames(core, tuple(frames), places) for (core, places), frames in distinct.items()
    )


def _list_places(
    tasks: Sequence[TimedTask], work: Work, start: int, minor: int
) -> Iterator[FramePlace]:
    """Yield when each task of a core runs within one minor frame, sorted by time.

    Args:
        tasks: Tasks of the core.
        work: Spans of all jobs.
        start: Start of the frame in ns.
        minor: Length of the frame in ns.
    """
    frame_end = start + minor
    released = sorted(
        (start + (task.phase_ns - start) % task.every_ns, -task.priority, task.name, task.cost_ns)
        for task in tasks
    )
    released = [release for release in released if release[0] < frame_end]
    begins = start
    for at, (release, _, board, cost_ns) in enumerate(released, 1):
        later = released[at:]
        limit = next((time for time, *_ in later if time > release), frame_end)
        is_last = not later or later[0][0] > release
        spans = work[board, release]
        done = sum(min(s.end_ns, limit) - s.start_ns for s in spans if s.start_ns < limit)
        # The limit is the next later release on this core, or the end of the frame. A job that is
        # not done by then is treated as ending at the limit.
        end = spans[-1].end_ns if done == cost_ns else limit
        begins = max(begins, release)
        yield FramePlace(
            board=board,
            offset_ns=begins - start,
            job_ns=cost_ns,
            limit_ns=(limit if is_last else end) - start,
            slack_ns=done - cost_ns + (limit - end if is_last else 0),
            until=later[0][2] if later else "",
        )
        begins = end
