"""Random plans: which faults strike a trial, where, and when. The same seed draws the same plans."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from random import Random
from typing import Any

from boards.faults.kinds import KINDS, NUMBERS
from tools.campaign.plan import EXTERNAL, Kill, Plan, Purpose
from tools.campaign.shape import SIZED, Drawing, Shape, shape, swept_sizes
from tools.campaign.targets import Target, Targets

FEWEST, MOST = 3, 5
"""Faults of one trial; as many as fit into the task."""
LEAD_S = 0.1
"""Simulated time before the first fault, at least."""
TAIL_S = 1.0
"""Simulated time of a faultless run for which a fault must not begin: it is to meet a task under way."""
SETTLE_S = 1.5
"""Simulated time between the end of a fault and the next one, beside the restart of a board: it recovers first."""
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
        """Return the tick up to which faults may begin."""
        return max(self.first() + 1, self.ticks - round(TAIL_S * self.second))

    def window(self, target: Target, length: int) -> int:
        """Return the ticks from the beginning of a fault to the next: it is seen, over, and recovered from."""
        restart = self.restart_s if target.kind in ("kill", "hang", "lock-held", EXTERNAL) else 0.0
        # A board that hangs is killed as soon as it is found: its fault is over then.
        lasts = 0 if target.kind == "hang" else length
        return max(lasts, 5 * target.cycle) + target.cycle + round((restart + SETTLE_S) * self.second)


class Deck:
    """Deals kinds at random, each as often as any other."""

    def __init__(self, kinds: Sequence[str], rng: Random) -> None:
        self._kinds, self._rng = list(kinds), rng
        self._cards: list[str] = []

    def deal(self, count: int) -> list[str]:
        """Return so many kinds; one that ends the run before it begins comes alone."""
        dealt: list[str] = []
        while len(dealt) < count:
            if not self._cards:
                self._cards = self._rng.sample(self._kinds, len(self._kinds))
            if ends_alone(self._cards[-1]):
                return dealt or [self._cards.pop()]
            dealt.append(self._cards.pop())
        return dealt


def ends_alone(kind: str) -> bool:
    """Say whether a kind needs a trial of its own: nothing goes on after it."""
    return kind != EXTERNAL and not KINDS[NUMBERS[kind]].recoverable


def fault_plans(course: Course, kinds: Sequence[str], seed: int, modes: Sequence[bool]) -> Iterator[Plan]:
    """Yield a plan for each of `modes`, True for lockstep, with some faults of these kinds.

    The kinds that a mode lacks are left out of its plans; where it lacks all, the mode has no plan.
    """
    decks = {mode: _deck(course, kinds, seed, mode) for mode in set(modes)}
    for number, mode in enumerate(modes, 1):
        if (found := decks[mode]) is not None:
            rng, deck = found
            wanted = [(kind, shape) for kind in deck.deal(rng.randint(FEWEST, MOST))]
            yield _filled(course, number, mode, "faults", wanted, rng)


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


def size_plans(course: Course, kinds: Sequence[str], count: int, seed: int, first: int) -> Iterator[Plan]:
    """Yield plans in lockstep with `count` sizes of every kind that is seen from a certain size on."""
    rng = Random(f"{seed} sizes")
    sizes = [(kind, size) for kind in SIZED if kind in kinds for size in swept_sizes(kind, count)]
    rng.shuffle(sizes)
    number = first
    while sizes:
        drawn, sizes = sizes[:MOST], sizes[MOST:]
        faults = [(kind, _resized(size)) for kind, size in drawn]
        plan = _filled(course, number, True, "sizes", faults, rng)
        # What did not fit into the run comes with the next one.
        sizes += drawn[len(plan.faults) :]
        number += 1
        yield plan


def _deck(course: Course, kinds: Sequence[str], seed: int, lockstep: bool) -> tuple[Random, Deck] | None:
    rng = Random(f"{seed} {'lockstep' if lockstep else 'realtime'}")
    fitting = [k for k in kinds if course.targets.by_kind[k] and not (lockstep and needs_real_time(k))]
    return (rng, Deck(fitting, rng)) if fitting else None


def needs_real_time(kind: str) -> bool:
    """Say whether a kind does not exist in lockstep."""
    return kind != EXTERNAL and KINDS[NUMBERS[kind]].realtime


def _filled(
    course: Course,
    number: int,
    lockstep: bool,
    purpose: Purpose,
    wanted: Sequence[tuple[str, Callable[[Drawing], Shape]]],
    rng: Random,
) -> Plan:
    """Return a plan with as many of the wanted faults as fit into the task, each behind the one before."""
    drawn: list[tuple[Target, Shape]] = []
    windows: list[int] = []
    for kind, shape_of in wanted:
        target = rng.choice(course.targets.by_kind[kind])
        found = shape_of(Drawing(rng, target, course.second, course.targets.joints))
        window = course.window(target, found.ticks)
        if drawn and sum(windows) + window > course.last() - course.first():
            break
        drawn.append((target, found))
        windows.append(window)
    faults, kills = [], []
    for (target, found), start in zip(drawn, _starts(course, windows, rng), strict=True):
        phase = _phase(rng)
        if target.kind == EXTERNAL:
            kills.append(Kill(target.board, start, phase))
        else:
            faults.append(_table(course, target, found, start, 0.0 if lockstep else phase, rng))
    return Plan(number, purpose, lockstep, tuple(faults), tuple(kills))


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


def _table(course: Course, target: Target, found: Shape, tick: int, phase: float, rng: Random) -> dict[str, Any]:
    kind = KINDS[NUMBERS[target.kind]]
    table: dict[str, Any] = {"kind": kind.name, "board": target.board}
    if kind.where != "start":
        table["tick"] = tick
    if found.ticks and not kind.once:
        table["for"] = round(found.ticks / course.second, 6)
    if phase and kind.takes_phase:
        table["phase"] = phase
    if target.mailbox is not None:
        table["mailbox"] = target.mailbox
    return {**table, "seed": rng.randrange(SEEDS), **found.parameters}


def _phase(rng: Random) -> float:
    return rng.randrange(PHASES) / PHASES


def _resized(size: float) -> Callable[[Drawing], Shape]:
    """Return a shape of one joint and one size: a point of the curve."""

    def resized(drawing: Drawing) -> Shape:
        found = shape(drawing)
        return Shape(found.ticks, {**found.parameters, "joint": drawing.rng.randrange(drawing.joints), "size": size})

    return resized
