"""Random plans: which faults strike a trial, where, and when. The same seed draws the same
plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from random import Random

from rack.backplane.fault_table import Injection
from rack.boards.faults.clock_board import PHASES
from rack.boards.faults.drawing import Drawing, swept
from rack.tools.console.answer import Document
from rack.tools.faults.campaigns.plan import Kill, Plan, Purpose, Target, Targets
from rack.tools.faults.ending import EXTERNAL, record_of

MOST_FAULTS = 40
"""Faults of one trial: as many as fit into the task, and into the fault table."""
LEAD_S = 0.1
"""Simulated time before the first fault, at least."""
TAIL_S = 1.0
"""Simulated time at the end of a faultless run in which no fault begins: it must strike a task
under way."""
SETTLE_S = 0.1
"""Simulated time between the end of all that a fault may lead to and the next fault."""
EPISODE = 25
"""Reads after which a reader reports the next fault of a mailbox again: those of `Episodes`, and
some more."""
AHEAD = 60
"""Waiting faults that are tried for one that still fits into a trial."""
KILL_GAP_S = 3.5
"""Simulated time between two kills from outside, at least: a restart takes up to two seconds of
real time."""
LEAST_TICKS = 20
"""Least time, in ticks, in which a fault that strikes no mailbox is found and over."""
SEEDS = 2**31


@dataclass(frozen=True)
class RackUnderTest:
    """The rack that plans are drawn for: its targets, ticks of a faultless run and of a second,
    time of a restart."""

    targets: Targets
    ticks: int
    second: float
    restart_s: float

    def first(self) -> int:
        """Return the first tick at which a fault may begin."""
        return round(LEAD_S * self.second)

    def last(self) -> int:
        """Return the tick up to which faults may begin, and their consequences last."""
        return max(self.first() + 1, self.ticks - round(TAIL_S * self.second))

    def window(self, target: Target, ticks: int, parameters: Mapping[str, float]) -> int:
        """Return the ticks from the beginning of a fault to the next: it is found, over, and
        recovered from."""
        layout = self.targets.layout
        kind = target.record
        tasks = [task.name for task in layout.tasks]
        boxes = [box.name for box in layout.mailboxes]
        task = tasks.index(target.board) if target.board in tasks else -1
        box = boxes.index(target.mailbox) if target.mailbox else -1
        values = tuple(parameters.get(p.name, p.default or 0.0) for p in kind.parameters)
        entry = Injection(kind.number, task, box, parameters=values)
        lasts = kind.bound_ticks(entry, layout) or 0
        if not kind.is_over_when_found:
            least = 2 * target.cycle + target.reader if target.mailbox else LEAST_TICKS
            lasts = max(lasts, ticks, least)
        recovery = kind.recovery_ticks(target.board, layout, self.restart_s)
        return lasts + recovery + round(SETTLE_S * self.second)


@dataclass(frozen=True)
class Card:
    """One fault that waits for its place in a trial. `ticks`: its length, 0 for a kind that strikes
    once."""

    target: Target
    ticks: int
    parameters: Mapping[str, float]
    window: int
    seed: int
    phase: float

    @classmethod
    def draw(cls, rack: RackUnderTest, kind: str, rng: Random, size: float | None = None) -> Card:
        """Draw a fault as the kind's record says; with a `size`, of a single joint, as a point of a
        curve."""
        target = rng.choice(rack.targets.by_kind[kind])
        record = target.record
        joints = rack.targets.joints
        drawing = Drawing(rng, target.cycle, target.reader, rack.second, joints)
        ticks = record.lasts(drawing) if record.lasts is not None else 0
        parameters = {p.name: p.drawn(drawing) for p in record.parameters if p.drawn is not None}
        if size is not None:
            if "joint" in parameters:
                parameters["joint"] = rng.randrange(joints)
            parameters["size"] = size
        window = rack.window(target, ticks, parameters)
        return cls(target, ticks, parameters, window, rng.randrange(SEEDS), _phase(rng))

    @property
    def quiet(self) -> int:
        """Ticks from the last message that a fault has touched to the next fault."""
        held = 0.0
        if self.target.record.where == "writer":
            held = self.parameters.get("by", 0) * self.target.cycle
        return self.window - self.ticks - round(held)

    def table(self, rack: RackUnderTest, tick: int, lockstep: bool) -> Document:
        """Return the fault as a `[[fault]]` table that begins at `tick`."""
        target = self.target
        kind = target.record
        table: Document = {"kind": kind.name, "board": target.board}
        if kind.where != "start":
            table["tick"] = tick
        if self.ticks and not kind.once:
            table["for"] = round(self.ticks / rack.second, 6)
        if self.phase and kind.within_tick and not lockstep:
            table["phase"] = self.phase
        if target.mailbox is not None:
            table["mailbox"] = target.mailbox
        return {**table, "seed": self.seed, **self.parameters}


def fault_plans(
    rack: RackUnderTest, counts: Mapping[str, int], seed: str, lockstep: bool, first: int
) -> list[Plan]:
    """Return plans, numbered from `first`, that have each of these kinds so many times.

    Faults come in random order, as many in a trial as fit into the task, one after the other.
    """
    mode = "lockstep" if lockstep else "realtime"
    rng = Random(f"{seed} {mode}")
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    rng.shuffle(kinds)
    cards = [Card.draw(rack, kind, rng) for kind in kinds]
    return _packed(rack, first, lockstep, "faults", cards, rng)


def kill_plans(
    rack: RackUnderTest, count: int, seed: int, modes: Sequence[bool], first: int
) -> list[Plan]:
    """Return plans of kills from outside, `count` in all, in these modes by turns, numbered from
    `first`."""
    rng = Random(f"{seed} kills")
    targets = rack.targets.by_kind[EXTERNAL]
    gap = KILL_GAP_S * rack.second
    a_run = max(1, int((rack.last() - rack.first()) / gap))
    plans = list[Plan]()
    for done in range(0, count, a_run):
        boards = [rng.choice(targets).board for _ in range(min(a_run, count - done))]
        starts = _starts(rack, [round(gap)] * len(boards), rng)
        kills = [Kill(b, tick, _phase(rng)) for b, tick in zip(boards, starts, strict=True)]
        lockstep = modes[len(plans) % len(modes)]
        plans.append(Plan(first + len(plans), "kills", lockstep, kills=tuple(kills)))
    return plans


def size_plans(
    rack: RackUnderTest, kinds: Sequence[str], count: int, seed: int, first: int
) -> list[Plan]:
    """Return plans in lockstep with `count` sizes of every kind that must be found from a certain
    size."""
    rng = Random(f"{seed} sizes")
    sizes = [(kind, size) for kind in kinds for size in swept_sizes(kind, count)]
    rng.shuffle(sizes)
    cards = [Card.draw(rack, kind, rng, size) for kind, size in sizes]
    return _packed(rack, first, True, "sizes", cards, rng)


def swept_sizes(kind: str, count: int) -> list[float]:
    """Return sizes for the curve of size against delay; none for a kind that is always visible."""
    record = record_of(kind)
    if record.visible_from is None or record.size is None:
        return []
    return swept(record.size.least, record.visible_from, count)


def _packed(
    rack: RackUnderTest,
    first: int,
    lockstep: bool,
    purpose: Purpose,
    cards: Sequence[Card],
    rng: Random,
) -> list[Plan]:
    """Return plans with all of these faults, as many in each as fit into the task."""
    plans = list[Plan]()
    waiting = list(cards)
    while waiting:
        chosen = _chosen(rack, waiting)
        starts = _starts(rack, [card.window for card in chosen], rng)
        faults = list[Document]()
        kills = list[Kill]()
        for card, start in zip(chosen, starts, strict=True):
            if card.target.kind == EXTERNAL:
                kills.append(Kill(card.target.board, start, card.phase))
            else:
                faults.append(card.table(rack, start, lockstep))
        plans.append(Plan(first + len(plans), purpose, lockstep, tuple(faults), tuple(kills)))
    return plans


def _chosen(rack: RackUnderTest, waiting: list[Card]) -> list[Card]:
    """Take the faults of one trial out of those that wait, the first of them always."""
    if not waiting[0].target.record.recoverable:
        return [waiting.pop(0)]
    chosen: list[Card] = []
    free = rack.last() - rack.first()
    busy = set[str | None]()
    for card in waiting[:AHEAD]:
        target = card.target
        fits = (
            card.window <= free
            and target.mailbox not in busy
            and target.record.recoverable
            and len(chosen) < MOST_FAULTS
        )
        if not chosen or fits:
            chosen.append(card)
            waiting.remove(card)
            free -= card.window
            is_quiet = card.quiet >= EPISODE * max(target.reader, target.cycle)
            if target.mailbox is not None and not is_quiet:
                busy.add(target.mailbox)
    return chosen


def _starts(rack: RackUnderTest, windows: Sequence[int], rng: Random) -> list[int]:
    """Return a tick for each window, in order: the rest of the run is shared out between them at
    random."""
    free = max(0, rack.last() - rack.first() - sum(windows))
    cuts = sorted(rng.randint(0, free) for _ in windows)
    # Each without a gap before it; after the last one comes the end.
    earliest = accumulate(windows, initial=rack.first())
    return [cut + tick for cut, tick in zip(cuts, earliest, strict=False)]


def _phase(rng: Random) -> float:
    return rng.randrange(PHASES) / PHASES
