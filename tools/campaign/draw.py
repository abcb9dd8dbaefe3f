"""Random plans: which faults strike a trial, where, and when. The same seed draws the same plans."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from random import Random
from typing import Any

from rack.boards.faults.consequences import recovery_ticks
from rack.boards.faults.kinds import KINDS, NUMBERS
from rack.tools.campaign.detection import table_kind
from rack.tools.campaign.plan import EXTERNAL, Kill, Plan, Purpose
from rack.tools.campaign.shape import SIZED, Drawing, Shape, shape, swept_sizes
from rack.tools.campaign.targets import Target, Targets

MOST = 40
"""Faults of one trial, at most: as many as fit into the task, and into the fault table."""
LEAD_S = 0.1
"""Simulated time before the first fault, at least."""
TAIL_S = 1.0
"""Simulated time of a faultless run for which a fault must not begin: it is to meet a task under way."""
SETTLE_S = 0.1
"""Simulated time between the end of all that a fault may lead to and the next fault."""
EPISODE = 25
"""Reads after which a reader tells of the next fault of a mailbox again: `rack.backplane.episodes`, and some more."""
AHEAD = 60
"""Faults that are looked at for one that still fits into a trial."""
KILL_GAP_S = 3.5
"""Simulated time between two kills from outside, at least: a restart takes up to two seconds of real time."""
SEEDS = 2**31
PHASES = 1000


@dataclass(frozen=True)
class Course:
    """What plans are drawn for: places, ticks of a faultless run and of a second, and how long a restart takes."""

    targets: Targets
    ticks: int
    second: float
    restart_s: float

    def first(self) -> int:
        """Return the first tick at which a fault may begin."""
        return round(LEAD_S * self.second)

    def last(self) -> int:
        """Return the tick up to which faults may begin, and what they lead to last."""
        return max(self.first() + 1, self.ticks - round(TAIL_S * self.second))

    def window(self, target: Target, length: int) -> int:
        """Return the ticks from the beginning of a fault to the next: it is seen, over, and recovered from."""
        layout, kind = self.targets.layout, table_kind(target.kind)
        # A board that hangs is killed as soon as it is found: its fault is over then.
        lasts = 0 if target.kind == "hang" else length
        # The slowest bound there is: five cycles of a task, its reader's cycle on top.
        seen = 5 * target.cycle if target.kind == "hang" else 2 * target.cycle + target.reader if target.mailbox else 20
        undone = recovery_ticks(kind, target.board, layout, self.restart_s)
        return max(lasts, seen) + undone + round(SETTLE_S * self.second)


@dataclass(frozen=True)
class Card:
    """One fault that waits for its place in a trial."""

    target: Target
    shape: Shape
    window: int
    seed: int
    phase: float

    @property
    def quiet(self) -> int:
        """Ticks from the last message that a fault has touched to the next fault."""
        held = self.shape.parameters.get("by", 0) * self.target.cycle if self.target.kind == "delay" else 0
        return self.window - self.shape.ticks - round(held)


def ends_alone(kind: str) -> bool:
    """Say whether a kind needs a trial of its own: nothing goes on after it."""
    return kind != EXTERNAL and not KINDS[NUMBERS[kind]].recoverable


def fault_plans(course: Course, counts: Mapping[str, int], seed: str, lockstep: bool, first: int) -> list[Plan]:
    """Return plans, numbered from `first`, that have each of these kinds so many times.

    Faults come in random order, as many in a trial as fit into the task, each behind the one before.
    """
    rng = Random(f"{seed} {'lockstep' if lockstep else 'realtime'}")
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    rng.shuffle(kinds)
    wanted = [(kind, shape) for kind in kinds]
    return _packed(course, first, lockstep, "faults", [_card(course, *one, rng) for one in wanted], rng)


def kill_plans(course: Course, count: int, seed: int, modes: Sequence[bool], first: int) -> Iterator[Plan]:
    """Yield plans of kills from outside, `count` in all, in these modes by turns, numbered from `first`."""
    rng, gap = Random(f"{seed} kills"), KILL_GAP_S * course.second
    a_run = max(1, int((course.last() - course.first()) / gap))
    for place, done in enumerate(range(0, count, a_run)):
        kills = []
        for _ in range(min(a_run, count - done)):
            kills.append(rng.choice(course.targets.by_kind[EXTERNAL]).board)
        starts = _starts(course, [round(gap)] * len(kills), rng)
        yield Plan(
            number=first + place,
            purpose="kills",
            lockstep=modes[place % len(modes)],
            kills=tuple(Kill(b, t, _phase(rng)) for b, t in zip(kills, starts, strict=True)),
        )


def size_plans(course: Course, kinds: Sequence[str], count: int, seed: int, first: int) -> list[Plan]:
    """Return plans in lockstep with `count` sizes of every kind that is seen from a certain size on."""
    rng = Random(f"{seed} sizes")
    sizes = [(kind, size) for kind in SIZED if kind in kinds for size in swept_sizes(kind, count)]
    rng.shuffle(sizes)
    cards = [_card(course, kind, _resized(size), rng) for kind, size in sizes]
    return _packed(course, first, True, "sizes", cards, rng)


def needs_real_time(kind: str) -> bool:
    """Say whether a kind does not exist in lockstep, or means nothing there: no time passes while a process dies."""
    return kind == EXTERNAL or KINDS[NUMBERS[kind]].realtime


def _card(course: Course, kind: str, shape_of: Callable[[Drawing], Shape], rng: Random) -> Card:
    target = rng.choice(course.targets.by_kind[kind])
    found = shape_of(Drawing(rng, target, course.second, course.targets.joints))
    return Card(target, found, course.window(target, found.ticks), rng.randrange(SEEDS), _phase(rng))


def _packed(
    course: Course, first: int, lockstep: bool, purpose: Purpose, cards: Sequence[Card], rng: Random
) -> list[Plan]:
    """Return plans with all of these faults, as many in each as fit into the task."""
    plans, waiting = list[Plan](), list(cards)
    while waiting:
        chosen = _chosen(course, waiting)
        faults, kills = list[dict[str, Any]](), list[Kill]()
        for card, start in zip(chosen, _starts(course, [card.window for card in chosen], rng), strict=True):
            if card.target.kind == EXTERNAL:
                kills.append(Kill(card.target.board, start, card.phase))
            else:
                faults.append(_table(course, card, start, 0.0 if lockstep else card.phase))
        plans.append(Plan(first + len(plans), purpose, lockstep, tuple(faults), tuple(kills)))
    return plans


def _chosen(course: Course, waiting: list[Card]) -> list[Card]:
    """Take the faults of one trial out of those that wait, the first of them always."""
    if ends_alone(waiting[0].target.kind):
        return [waiting.pop(0)]
    chosen: list[Card] = []
    free, busy = course.last() - course.first(), set[str]()
    for card in waiting[:AHEAD]:
        target, is_first = card.target, not chosen
        is_told = target.mailbox is None or target.mailbox not in busy
        if is_first or (card.window <= free and is_told and len(chosen) < MOST and not ends_alone(target.kind)):
            chosen.append(card)
            waiting.remove(card)
            free -= card.window
            if target.mailbox is not None and EPISODE * max(target.reader, target.cycle) > card.quiet:
                busy.add(target.mailbox)
    return chosen


def _starts(course: Course, windows: Sequence[int], rng: Random) -> list[int]:
    """Return a tick for each window, in order: what the run has beside them is shared out at random."""
    free = max(0, course.last() - course.first() - sum(windows))
    cuts = sorted(rng.randint(0, free) for _ in windows)
    gaps = [later - earlier for earlier, later in pairwise([0, *cuts])]
    starts, at = [], course.first()
    for gap, window in zip(gaps, windows, strict=True):
        starts.append(at + gap)
        at += gap + window
    return starts


def _table(course: Course, card: Card, tick: int, phase: float) -> dict[str, Any]:
    target, found, kind = card.target, card.shape, KINDS[NUMBERS[card.target.kind]]
    table: dict[str, Any] = {"kind": kind.name, "board": target.board}
    if kind.where != "start":
        table["tick"] = tick
    if found.ticks and not kind.once:
        table["for"] = round(found.ticks / course.second, 6)
    if phase and kind.takes_phase:
        table["phase"] = phase
    if target.mailbox is not None:
        table["mailbox"] = target.mailbox
    return {**table, "seed": card.seed, **found.parameters}


def _phase(rng: Random) -> float:
    return rng.randrange(PHASES) / PHASES


def _resized(size: float) -> Callable[[Drawing], Shape]:
    """Return a shape of one joint and one size: a point of the curve."""

    def resized(drawing: Drawing) -> Shape:
        found = shape(drawing)
        return Shape(found.ticks, {**found.parameters, "joint": drawing.rng.randrange(drawing.joints), "size": size})

    return resized
