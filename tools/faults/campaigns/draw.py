"""Random plans: which faults act in a trial, where and when. Equal seeds draw equal plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, takewhile
from random import Random

from rack.backplane.fault_table import Injection
from rack.boards.faults.clock_board import PHASES
from rack.boards.faults.drawing import Drawing, list_sweep_sizes
from rack.tools.console.answer import Document
from rack.tools.faults.campaigns.plan import Kill, Plan, Purpose, Target, Targets
from rack.tools.faults.ending import EXTERNAL, find_record

MAX_FAULTS = 40
"""Maximum number of faults in a trial. The fault table has room for a few more."""
LEAD_S = 0.1
"""Minimum simulated time in s before the first fault."""
TAIL_S = 1.0
"""Simulated time in s at the end of a faultless run in which no fault begins.

A fault must act while the task is being executed.
"""
SETTLE_S = 0.1
"""Simulated time in s between the last possible effect of a fault and the next fault."""
EPISODE_READS = 25
"""Number of reads after which a reader reports another fault of the same mailbox, with a margin.

See `Episodes` for the number itself.
"""
MAX_EXTENSION_S = 0.25
"""Maximum simulated time in s by which a window is extended to use its mailbox again."""
ARM_STOP_S = 0.5
"""Simulated time in s by which each fault that stops the arm prolongs the task.

For NASREM it is 0.5 to 1.6 s. Faults after the end of the task do not act and are drawn again.
"""
SHUFFLES = 20
"""Number of random orders that are tried for the faults of a trial."""
BATCH_FAULTS = 1000
"""Number of faults that are distributed over trials at a time."""
KILL_GAP_S = 3.5
"""Minimum simulated time in s between two external kills. A restart takes up to 2 s."""
MIN_TICKS = 20
"""Minimum time in ticks that a fault without a mailbox needs to be detected and to end."""
SEEDS = 2**31


@dataclass(frozen=True)
class RackUnderTest:
    """The rack for which plans are drawn.

    Attributes:
        targets: Possible targets of faults.
        ticks: Length of a faultless run in ticks.
        second: Number of ticks in a simulated second.
        restart_s: Simulated time in s that a restart may take.
    """

    targets: Targets
    ticks: int
    second: float
    restart_s: float

    @property
    def first_tick(self) -> int:
        """First tick at which a fault may begin."""
        return round(LEAD_S * self.second)

    @property
    def room_ticks(self) -> int:
        """Number of ticks of a faultless run that are available for faults and their effects."""
        return max(1, self.ticks - round(TAIL_S * self.second) - self.first_tick)

    def compute_window(self, target: Target, ticks: int, parameters: Mapping[str, float]) -> int:
        """Return the minimum time from the beginning of a fault to the next fault.

        It is long enough for the fault to be detected and to end, and for the rack to recover.

        Args:
            target: Target of the fault.
            ticks: Duration of the fault in ticks.
            parameters: Dictionary from names to values of its parameters. Missing ones have their
                defaults.

        Returns:
            The time in ticks.
        """
        layout = self.targets.layout
        kind = target.record
        tasks = [task.name for task in layout.tasks]
        boxes = [box.name for box in layout.mailboxes]
        task = tasks.index(target.board) if target.board in tasks else -1
        box = boxes.index(target.mailbox) if target.mailbox else -1
        values = tuple(parameters.get(p.name, p.default or 0.0) for p in kind.parameters)
        entry = Injection(kind.number, task, box, parameters=values)
        duration = kind.compute_bound_ticks(entry, layout) or 0
        # A fault that ends its process ends once it is detected, because the Rack then kills it.
        if kind.once or not kind.consequence.ends_process:
            min_duration = 2 * target.cycle + target.reader if target.mailbox else MIN_TICKS
            duration = max(duration, ticks + kind.compute_tail_ticks(entry, layout), min_duration)
        recovery = kind.compute_recovery_ticks(target.board, layout, self.restart_s)
        return duration + recovery + round(SETTLE_S * self.second)


@dataclass(frozen=True)
class FaultCard:
    """One drawn fault, to be assigned to a trial.

    Attributes:
        target: Target of the fault.
        ticks: Duration in ticks. 0 for a kind that acts once.
        parameters: Values of its parameters.
        window: Ticks from its beginning to the next fault.
        room: Ticks of a faultless run that the fault takes up: its window without the ticks by
            which it prolongs the task.
        may_repeat: Whether another fault of the same trial may affect its mailbox, because readers
            report that fault too.
        seed: Seed of the fault.
        phase: Fraction of the first tick that passes before it acts.
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
    def draw_card(
        cls, rack: RackUnderTest, kind: str, rng: Random, size: float | None = None
    ) -> FaultCard:
        """Draw a fault from the distributions in the record of its kind.

        Args:
            rack: The rack.
            kind: Name of the kind.
            rng: Random generator.
            size: Size of the fault, for a point of a curve. The fault then affects a single joint.
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
        window = rack.compute_window(target, ticks, parameters)
        reported_ticks = 0
        if target.mailbox is not None:
            delay_ticks = parameters.get("by", 0) * target.cycle if record.where == "writer" else 0
            reported_ticks = (
                ticks + round(delay_ticks) + EPISODE_READS * max(target.reader, target.cycle)
            )
        if window < reported_ticks <= window + MAX_EXTENSION_S * rack.second:
            window = reported_ticks
        is_stop = parameters.get("size", 0.0) >= (record.visible_from or 0.0)
        prolonged_ticks = (
            round(ARM_STOP_S * rack.second) if record.where == "arm" and is_stop else 0
        )
        return cls(
            target=target,
            ticks=ticks,
            parameters=parameters,
            window=window,
            room=window - prolonged_ticks,
            may_repeat=window >= reported_ticks,
            seed=rng.randrange(SEEDS),
            phase=_draw_phase(rng),
        )

    def to_table(self, rack: RackUnderTest, tick: int, lockstep: bool) -> Document:
        """Return the fault as a `[[fault]]` table.

        Args:
            rack: The rack.
            tick: Tick at which the fault begins.
            lockstep: Whether the trial is in lockstep, where faults have no phase.
        """
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
    """Draw plans with the given number of faults of each kind, in random order.

    Each trial has as many faults as fit into the task one after the other.

    Args:
        rack: The rack.
        counts: Number of faults of each kind.
        seed: Seed of the draws.
        lockstep: Whether the trials are in lockstep.
        first: Number of the first trial.
    """
    mode = "lockstep" if lockstep else "realtime"
    rng = Random(f"{seed} {mode}")
    kinds = [kind for kind, count in counts.items() for _ in range(count)]
    rng.shuffle(kinds)
    cards = [FaultCard.draw_card(rack, kind, rng) for kind in kinds]
    return _pack_plans(rack, first, lockstep, "faults", cards, rng)


def kill_plans(
    rack: RackUnderTest, count: int, seed: int, modes: Sequence[bool], first: int
) -> list[Plan]:
    """Draw plans of external kills, which do not use the fault table.

    Args:
        rack: The rack.
        count: Number of kills.
        seed: Seed of the draws.
        modes: Clock modes that the trials use in turn, True for lockstep.
        first: Number of the first trial.
    """
    rng = Random(f"{seed} kills")
    targets = rack.targets.by_kind[EXTERNAL]
    gap_ticks = KILL_GAP_S * rack.second
    kills_per_run = max(1, int(rack.room_ticks / gap_ticks))
    plans = list[Plan]()
    for done in range(0, count, kills_per_run):
        boards = [rng.choice(targets).board for _ in range(min(kills_per_run, count - done))]
        starts = _draw_starts(rack, [round(gap_ticks)] * len(boards), rng)
        kills = [Kill(b, tick, _draw_phase(rng)) for b, tick in zip(boards, starts, strict=True)]
        lockstep = modes[len(plans) % len(modes)]
        plans.append(Plan(first + len(plans), "kills", lockstep, kills=tuple(kills)))
    return plans


def size_plans(
    rack: RackUnderTest, kinds: Sequence[str], count: int, seed: int, first: int
) -> list[Plan]:
    """Draw lockstep plans for the curves of size against detection delay.

    Args:
        rack: The rack.
        kinds: Names of kinds. Kinds that are detectable at any size are omitted.
        count: Number of sizes of each kind.
        seed: Seed of the draws.
        first: Number of the first trial.
    """
    rng = Random(f"{seed} sizes")
    sizes = [(kind, size) for kind in kinds for size in list_swept_sizes(kind, count)]
    rng.shuffle(sizes)
    cards = [FaultCard.draw_card(rack, kind, rng, size) for kind, size in sizes]
    return _pack_plans(rack, first, True, "sizes", cards, rng)


def list_swept_sizes(kind: str, count: int) -> list[float]:
    """Return the fault sizes for a kind's curve. Empty if the kind is detectable at any size."""
    record = find_record(kind)
    if record.visible_from is None or record.size is None:
        return []
    return list_sweep_sizes(record.size.least, record.visible_from, count)


class TrialShare:
    """The faults that are assigned to one trial.

    Attributes:
        cards: The faults.
        room: Number of ticks that remain for more faults.
    """

    def __init__(self, room_ticks: int) -> None:
        self.cards: list[FaultCard] = []
        self.room = room_ticks
        # Dictionary from each affected mailbox to True if another fault may affect it too.
        self._struck: dict[str, bool] = {}

    def has_room_for(self, card: FaultCard) -> bool:
        """Return True if a fault fits into the trial. The first fault always fits."""
        box = card.target.mailbox
        if box in self._struck and not (self._struck[box] and card.may_repeat):
            return False
        fits = card.room <= self.room and len(self.cards) < MAX_FAULTS
        return fits or not self.cards

    def add_card(self, card: FaultCard) -> None:
        """Assign a fault to the trial."""
        self.cards.append(card)
        self.room -= card.room
        if card.target.mailbox is not None:
            self._struck[card.target.mailbox] = card.may_repeat


def _pack_plans(
    rack: RackUnderTest,
    first: int,
    lockstep: bool,
    purpose: Purpose,
    cards: Sequence[FaultCard],
    rng: Random,
) -> list[Plan]:
    """Assign faults to as few trials as possible and return the plans of the trials."""
    shared = [card for card in cards if card.target.record.recoverable]
    trials = [
        share.cards
        for first_card in range(0, len(shared), BATCH_FAULTS)
        for share in _distribute_cards(
            rack.room_ticks, shared[first_card : first_card + BATCH_FAULTS]
        )
    ]
    trials += [[card] for card in cards if not card.target.record.recoverable]
    plans = list[Plan]()
    for trial_cards in trials:
        trial_cards = _choose_order(rack.room_ticks, trial_cards, rng)
        starts = _draw_starts(rack, [card.window for card in trial_cards], rng)
        faults = list[Document]()
        kills = list[Kill]()
        for card, start in zip(trial_cards, starts, strict=True):
            if card.target.kind == EXTERNAL:
                kills.append(Kill(card.target.board, start, card.phase))
            else:
                faults.append(card.to_table(rack, start, lockstep))
        plans.append(Plan(first + len(plans), purpose, lockstep, tuple(faults), tuple(kills)))
    return plans


def _distribute_cards(room_ticks: int, cards: Sequence[FaultCard]) -> list[TrialShare]:
    """Assign each fault, longest first, to the fullest trial that has room for it."""
    shares: list[TrialShare] = []
    for card in sorted(cards, key=lambda card: -card.window):
        fitting = [share for share in shares if share.has_room_for(card)]
        if not fitting:
            fitting = [TrialShare(room_ticks)]
            shares += fitting
        min(fitting, key=lambda share: share.room).add_card(card)
    return shares


def _choose_order(room_ticks: int, cards: Sequence[FaultCard], rng: Random) -> list[FaultCard]:
    """Return the faults of a trial in the best of several random orders.

    In the best order, each fault begins before the end of the task, which earlier faults may
    prolong, and the first fault of the arm begins as late as possible, because the arm is at rest
    at first.
    """
    orders = [rng.sample(cards, len(cards)) for _ in range(SHUFFLES)]

    def rate_order(order: list[FaultCard]) -> tuple[bool, int]:
        """Return whether all faults fit, and the ticks before the first fault of the arm."""
        needed = max(accumulate(card.room for card in order))
        cards_before = takewhile(lambda card: card.target.record.where != "arm", order)
        return needed <= room_ticks, sum(card.window for card in cards_before)

    return max(orders, key=rate_order)


def _draw_starts(rack: RackUnderTest, windows: Sequence[int], rng: Random) -> list[int]:
    """Return the start ticks of consecutive windows. The first start is random.

    A later start makes the trial shorter, because it continues from the last snapshot before its
    first fault.
    """
    spare_ticks = max(rack.first_tick, rack.room_ticks - sum(windows))
    earliest = accumulate(windows, initial=rack.first_tick + rng.randint(0, spare_ticks))
    return list(earliest)[:-1]


def _draw_phase(rng: Random) -> float:
    """Draw the fraction of a tick after which a fault acts."""
    return rng.randrange(PHASES) / PHASES
