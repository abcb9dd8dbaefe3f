"""Random plans: which faults strike a trial, where, and when. The same seed draws the same
plans.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, takewhile
from random import Random

from rack.backplane.fault_table import Injection
from rack.boards.faults.clock_board import PHASES
from rack.boards.faults.drawing import Drawing, swept
from rack.tools.console.answer import Document
from rack.tools.faults.campaigns.plan import Kill, Plan, Purpose, Target, Targets
from rack.tools.faults.ending import EXTERNAL, record_of

MOST_FAULTS = 40
"""Faults of one trial, at most: the fault table holds a few more."""
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
MORE_S = 0.25
"""Simulated time by which a window grows, at most, so that its mailbox may be struck again."""
HOLDS_UP_S = 0.5
"""Simulated time by which the task ends later for each fault that stops the arm: 0.5 to 1.6 s for
NASREM's. What comes after its end does not strike, and is drawn again."""
SHUFFLES = 20
"""Orders that are tried for the faults of a trial."""
BATCH = 1000
"""Faults that are shared out between trials at a time."""
KILL_GAP_S = 3.5
"""Simulated time between two kills from outside, at least: a restart takes up to two seconds of
real time."""
LEAST_TICKS = 20
"""Least time, in ticks, in which a fault that strikes no mailbox is found and over."""
SEEDS = 2**31


@dataclass(frozen=True)
class RackUnderTest:
    """The rack that plans are drawn for: its targets, ticks of a faultless run and of a second,
    time of a restart.
    """

    targets: Targets
    ticks: int
    second: float
    restart_s: float

    @property
    def first(self) -> int:
        """The first tick at which a fault may begin."""
        return round(LEAD_S * self.second)

    @property
    def room(self) -> int:
        """The ticks from there in which faults may begin, and their consequences last."""
        return max(1, self.ticks - round(TAIL_S * self.second) - self.first)

    def window(self, target: Target, ticks: int, parameters: Mapping[str, float]) -> int:
        """Return the ticks from the beginning of a fault to the next: it is found, over, and
        recovered from.
        """
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
    """One fault that waits for its place in a trial.

    `ticks`: its length, 0 for a kind that strikes once. `may_repeat`: its mailbox may be struck
    again in the same trial, since after its window readers tell of the next fault, too. `room`: the
    ticks of a faultless run that it takes, without those by which it makes the task end later.
    """

    target: Target
    ticks: int
    parameters: Mapping[str, float]
    window: int
    room: int
    may_repeat: bool
    seed: int
    phase: float

    @classmethod
    def draw(cls, rack: RackUnderTest, kind: str, rng: Random, size: float | None = None) -> Card:
        """Draw a fault as the kind's record says; with a `size`, of a single joint, as a point of a
        curve.
        """
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
        told = 0
        if target.mailbox is not None:
            held = parameters.get("by", 0) * target.cycle if record.where == "writer" else 0
            told = ticks + round(held) + EPISODE * max(target.reader, target.cycle)
        if window < told <= window + MORE_S * rack.second:
            window = told
        is_stop = parameters.get("size", 0.0) >= (record.visible_from or 0.0)
        holds_up = round(HOLDS_UP_S * rack.second) if record.where == "arm" and is_stop else 0
        return cls(
            target=target,
            ticks=ticks,
            parameters=parameters,
            window=window,
            room=window - holds_up,
            may_repeat=window >= told,
            seed=rng.randrange(SEEDS),
            phase=_phase(rng),
        )

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
    `first`.
    """
    rng = Random(f"{seed} kills")
    targets = rack.targets.by_kind[EXTERNAL]
    gap = KILL_GAP_S * rack.second
    a_run = max(1, int(rack.room / gap))
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
    size.
    """
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


class Share:
    """The faults that one trial is given. `room`: ticks that are left for more."""

    def __init__(self, room: int) -> None:
        self.cards: list[Card] = []
        self.room = room
        self._struck: dict[str, bool] = {}  # mailboxes, and whether others may follow

    def takes(self, card: Card) -> bool:
        """Say whether a fault fits in; the first one always does."""
        box = card.target.mailbox
        if box in self._struck and not (self._struck[box] and card.may_repeat):
            return False
        fits = card.room <= self.room and len(self.cards) < MOST_FAULTS
        return fits or not self.cards

    def add(self, card: Card) -> None:
        """Take a fault in."""
        self.cards.append(card)
        self.room -= card.room
        if card.target.mailbox is not None:
            self._struck[card.target.mailbox] = card.may_repeat


def _packed(
    rack: RackUnderTest,
    first: int,
    lockstep: bool,
    purpose: Purpose,
    cards: Sequence[Card],
    rng: Random,
) -> list[Plan]:
    """Return plans with all of these faults, in as few trials as they fit into."""
    shared = [card for card in cards if card.target.record.recoverable]
    trials = [
        share.cards
        for at in range(0, len(shared), BATCH)
        for share in _shared_out(rack.room, shared[at : at + BATCH])
    ]
    trials += [[card] for card in cards if not card.target.record.recoverable]
    plans = list[Plan]()
    for chosen in trials:
        chosen = _ordered(rack.room, chosen, rng)
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


def _shared_out(room: int, cards: Sequence[Card]) -> list[Share]:
    """Share faults out between trials: the longest first, each where least room is left."""
    shares: list[Share] = []
    for card in sorted(cards, key=lambda card: -card.window):
        fitting = [share for share in shares if share.takes(card)]
        if not fitting:
            fitting = [Share(room)]
            shares += fitting
        min(fitting, key=lambda share: share.room).add(card)
    return shares


def _ordered(room: int, cards: Sequence[Card], rng: Random) -> list[Card]:
    """Return faults in the best of some random orders: if possible each begins before the end of a
    task that those before it have prolonged, and those of the arm late: at first it is at rest.
    """
    orders = [rng.sample(cards, len(cards)) for _ in range(SHUFFLES)]

    def quality(order: list[Card]) -> tuple[bool, int]:
        needed = max(accumulate(card.room for card in order))
        before = takewhile(lambda card: card.target.record.where != "arm", order)
        return needed <= room, sum(card.window for card in before)

    return max(orders, key=quality)


def _starts(rack: RackUnderTest, windows: Sequence[int], rng: Random) -> list[int]:
    """Return a tick for each window, one after the other from a random tick on: a trial goes on
    from the snapshot before its first fault.
    """
    free = max(rack.first, rack.room - sum(windows))
    earliest = accumulate(windows, initial=rack.first + rng.randint(0, free))
    return list(earliest)[:-1]


def _phase(rng: Random) -> float:
    return rng.randrange(PHASES) / PHASES
