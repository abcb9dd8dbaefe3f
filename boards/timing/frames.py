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
from dataclasses import dataclass
from typing import Any

from rack.boards.timing.rack import RackTiming
from rack.boards.timing.response_time import as_one_part
from rack.boards.timing.schedule import Span, simulate
from rack.boards.timing.tasks import TimedTask

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
    places.
    """

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
    tasks = [
        as_one_part(task, rack.context_switch_ns) for task in rack.tasks if task.role != "planner"
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
    frame_end = start + minor
    released = sorted(
        (start + (task.phase_ns - start) % task.every_ns, -task.priority, task.name, task.cost_ns)
        for task in tasks
    )
    released = [found for found in released if found[0] < frame_end]
    begins = start
    for at, (release, _, board, cost_ns) in enumerate(released, 1):
        later = released[at:]
        limit = next((time for time, *_ in later if time > release), frame_end)
        is_last = not later or later[0][0] > release
        spans = work[board, release]
        done = sum(min(s.end_ns, limit) - s.start_ns for s in spans if s.start_ns < limit)
        # What is not done by the limit ends there.
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
