"""Racks in lockstep step as one: each cycle of an adapter ends when those of all racks that work
together have begun.

In the cycle released at simulated time t an adapter sends its step: the time t, and everything that
its rack exports then. It waits for the step of t from every other rack, then passes on what they
have exported up to t. As a message becomes visible at the end of its cycle, nobody needs more, and
the imports depend on ticks alone. No clock gets further ahead of another than two of these cycles,
and while one is held, all are.

Exports travel in the step: a cycle costs one message, and nothing depends on the order of several.
Alternatives considered: a mark after the exports (each costs a message, and the network keeps order
within one key only), a barrier in the clock at every tick (the clock would wait for the network
even where no message is due; an adapter at the rate of the clock comes to the same), and one rack
that steps the others (one more process on which all depend).

A step that somebody could not receive is sent again: to a rack that comes, and to an adapter that
sends its first. A rack whose adapter dies is awaited, since its board may be restarted; one that
ends says so, and is lost from the next cycle on.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import IntFlag
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple, NoReturn

import zenoh
from xxhash import xxh3_64_intdigest as xxh3
from zenoh.ext import Int64, ZDeserializeError, z_deserialize, z_serialize

from rack.backplane.segment import Segment
from rack.backplane.words import Block, System
from rack.boards.lan.awaited import GIVE_UP_S, Why, word_of
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.keys import ALL_ALIVE, launch_and_cycle, step_key
from rack.boards.lan.link import MOST_STEP, Arrived, LanLink
from rack.boards.lan.peers import NONE
from rack.levels.errors import CannotGoOn

STEP_KIND = xxh3(b"rack step 2")
_CONTENT: Any = tuple[Int64, list[str], list[tuple[str, bytes, bytes]]]
"""Length of the cycle, racks, and of each export the key, the envelope and the payload."""


class StepFlag(IntFlag):
    """What else a step says, in the flags of its envelope."""

    FIRST = 1  # this process needs the newest step of the others
    OVER = 2  # the run has ended, and this was its last step


class Step(NamedTuple):
    """One step of a rack. `cycle_ns`: length of its adapter's cycle; `racks`: those for which it
    waits.
    """

    head: Envelope
    cycle_ns: int
    racks: list[str]
    exports: list[Arrived]


def pack_step(cycle_ns: int, racks: Iterable[str], exports: Sequence[Arrived]) -> bytes:
    """Return the content of a step."""
    parts = [(export.key, export.envelope or b"", export.payload) for export in exports]
    return z_serialize((Int64(cycle_ns), list(racks), parts)).to_bytes()


def unpack_step(head: Envelope, content: bytes) -> Step | None:
    """Return the step with this head; None if it is no step, or malformed."""
    if head.kind != STEP_KIND:
        return None
    try:
        cycle_ns, racks, parts = z_deserialize(_CONTENT, zenoh.ZBytes(content))
    except ZDeserializeError:
        return None
    exports = [Arrived(*part) for part in parts]
    # What is left behind the last part would be ignored.
    if pack_step(cycle_ns, racks, exports) != content:
        return None
    return Step(head, cycle_ns, racks, exports)


LOOK_S = 0.1
"""Time between two looks at the end of the run, while a rack is awaited."""
NEVER = -1


class Partner:
    """A rack that steps with this one.

    `launch` is that of its steps, `time_ns` the simulated time of the newest; `steps` are not
    passed on yet. Nothing more comes of one that `is_out`.
    """

    def __init__(self, rack: str, place: int) -> None:
        self.rack = rack
        self.place = place
        self.forget()

    def forget(self) -> None:
        """Await it anew."""
        self.launch = NONE
        self.time_ns = NEVER
        self.steps: deque[Step] = deque()
        self.is_out = self.is_there = False
        self.gone_s: float | None = None
        """CLOCK_MONOTONIC at which it was found gone; None: it is there, or has not come yet."""

    @property
    def word(self) -> int:
        """The word that says it is awaited."""
        seen = Why.UNSEEN if self.launch == NONE else Why.SLOWER
        return word_of(self.place, seen if self.gone_s is None else Why.GONE)

    def is_gone_for(self, time_s: float) -> bool:
        """Return True if it has been gone for longer than that."""
        return self.gone_s is not None and time.monotonic() - self.gone_s > time_s

    def has_reached(self, now_ns: int) -> bool:
        """Say whether nothing more comes of it up to this time."""
        return self.time_ns >= now_ns or self.is_out

    def take(self, step: Step) -> None:
        """Note a step, which may have come before."""
        self.gone_s = None
        if step.head.time_ns > self.time_ns:
            self.time_ns = step.head.time_ns
            self.steps.append(step)
        self.is_out = bool(step.head.flags & StepFlag.OVER)

    def passed(self, now_ns: int) -> Iterator[Step]:
        """Yield its steps up to this time, once."""
        while self.steps and self.steps[0].head.time_ns <= now_ns:
            yield self.steps.popleft()


class Barrier:
    """The end of an adapter's cycles, common to all racks in lockstep.

    Exports and imports use it in place of the `LanLink`, with the same methods.
    """

    def __init__(
        self, segment: Segment, board: str, racks: Iterable[str], lost: Iterable[str]
    ) -> None:
        """Step with `racks`, except those that an adapter before this one has `lost`."""
        self._segment = segment
        self._block = segment.block(board)
        self._partners = {rack: Partner(rack, place) for place, rack in enumerate(racks)}
        for rack in lost:
            self._partners[rack].is_out = True
        self._tick_ns = segment.layout.clock_ns
        self.cycle_ns = segment.layout.task(board).every * self._tick_ns
        """Length of the adapter's cycle, ns of simulated time; equal in all racks."""
        self.done = self._block[Block.DONE]
        """Last cycle that an adapter before this one has finished, a tick; -1: none."""
        self._is_restarted = self.done >= 0
        # What has been passed on does not come again.
        self._passed_ns = self.done * self._tick_ns if self._is_restarted else NEVER
        self._is_first = True
        self._has_begun = self._is_restarted
        self._has_refused = False
        self._block[Block.AWAITS] = 0
        self._exports: list[Arrived] = []
        self._imports: dict[str, deque[Arrived]] = {}
        self._changes: list[tuple[str, int, bool]] = []
        # A rack is one step ahead of what another has received, at most.
        self._steps: deque[tuple[int, bytes]] = deque(maxlen=2)
        self._now_ns = NEVER
        self._sent = 0
        self._events: SimpleQueue[zenoh.Sample] = SimpleQueue()
        self._kept: list[object] = []

    def open(self, link: LanLink, launch: int) -> None:
        """Listen to the others. Call it before this launch shows that it is there."""
        self._rack = link.rack
        self._launch = launch
        self._sealer = link.sealer.taking(MOST_STEP)
        self._key = step_key(link.rack)
        self._put = link.publish(self._key, reliable=True)
        # Called by a thread of the network: it wakes the cycle that waits, and does no more.
        handler = zenoh.handlers.Callback(self._events.put, indirect=False)
        for partner in self._partners.values():
            self._kept.append(link.session.declare_subscriber(step_key(partner.rack), handler))
            if self._is_restarted:
                # It may have ended meanwhile.
                partner.gone_s = time.monotonic()
        self._kept.append(
            link.session.liveliness().declare_subscriber(ALL_ALIVE, handler, history=True)
        )

    def publish(self, key: str) -> Callable[[bytes, bytes], None]:
        """Return a function that sends payload and envelope under a key expression, in the step of
        this cycle.
        """
        return lambda payload, envelope: self._exports.append(Arrived(key, envelope, payload))

    def subscribe(self, key: str) -> Callable[[], Iterator[Arrived]]:
        """Return a function that yields what others have sent under a key expression up to this
        cycle, once.
        """
        waiting = self._imports.setdefault(key, deque())
        return lambda: (waiting.popleft() for _ in range(len(waiting)))

    def changes(self) -> Iterator[tuple[str, int, bool]]:
        """Yield rack, launch, and whether it has come or gone, since the last call."""
        changes = self._changes
        self._changes = []
        yield from changes

    def prepare(self, tick: int) -> None:
        """Make a step of what was published since the last one."""
        awaited = [partner.rack for partner in self._partners.values() if not partner.is_out]
        content = pack_step(self.cycle_ns, awaited, self._exports)
        self._exports = []
        if len(content) > MOST_STEP:
            self._refuse(f"a cycle exports {len(content)} bytes; lockstep permits {MOST_STEP}")
        self._steps.append((tick * self._tick_ns, content))

    def meet(self, tick: int) -> bool:
        """Send the step of this cycle, and wait for those of all others; return False if the run is
        over.

        Raises `CannotGoOn` if a rack cannot step with this one.
        """
        self._now_ns = now_ns = tick * self._tick_ns
        self.prepare(tick)
        if self._is_first:
            self._send_again(StepFlag.FIRST)
        else:
            self._send(*self._steps[-1], StepFlag(0))
        while late := [
            partner for partner in self._partners.values() if not partner.has_reached(now_ns)
        ]:
            try:
                self._note(self._events.get(timeout=LOOK_S))
            except Empty:
                if self._is_over:
                    return False
                # Show for whom we wait, and give up one who is gone for too long.
                first = late[0]
                self._block[Block.AWAITS] = first.word
                first.is_out |= first.is_gone_for(GIVE_UP_S)
        self._block[Block.AWAITS] = 0
        for partner in self._partners.values():
            self._pass_on(partner)
        self._is_first = False
        self._has_begun = True
        return True

    def close(self) -> None:
        """Let the others go on without this rack, if its run has ended: a board alone may come
        back.
        """
        if self._steps and (self._is_over or self._has_refused):
            self._send(*self._steps[-1], StepFlag.OVER | self._first)

    def _send(self, time_ns: int, content: bytes, flags: StepFlag) -> None:
        self._sent += 1
        tick = time_ns // self._tick_ns
        head = Envelope(
            STEP_KIND, self._launch, self._sent, self._sent, tick, time_ns, time_ns, flags
        )
        self._put(content, self._sealer.seal(self._key, head, content))

    def _send_again(self, flags: StepFlag) -> None:
        """Send the newest steps to somebody who may not have received them; others ignore them."""
        for time_ns, content in self._steps:
            self._send(time_ns, content, flags)

    @property
    def _first(self) -> StepFlag:
        return StepFlag.FIRST if self._is_first else StepFlag(0)

    @property
    def _is_over(self) -> bool:
        return bool(self._segment.words[System.STOP_REQUEST]) or self._segment.run_is_over

    def _note(self, sample: zenoh.Sample) -> None:
        """Note what has come: a step of another rack, or the sign that it is there or gone."""
        key = str(sample.key_expr)
        partner = self._partners.get(key.split("/")[1])
        if partner is None or partner.is_out:
            return
        if key != step_key(partner.rack):
            if (found := launch_and_cycle(key)) is not None:
                self._note_sign(partner, *found, sample.kind == zenoh.SampleKind.PUT)
            return
        arrived = Arrived.of(sample)
        head = self._sealer.opened(*arrived)
        step = None if isinstance(head, Flaw) else unpack_step(head, arrived.payload)
        if step is not None and self._is_of(partner, step.head.launch):
            self._note_step(partner, step)

    def _note_sign(self, partner: Partner, launch: int, cycle_ns: int, is_there: bool) -> None:
        if is_there and partner.launch in (NONE, launch):
            self._check_cycle(partner, cycle_ns)
            partner.gone_s = None
            # It has come, or come back: what was sent meanwhile is lost.
            self._send_again(self._first)
        elif is_there:
            self._is_of(partner, launch)
        elif partner.launch == launch:
            partner.gone_s = time.monotonic()
            if not self._has_begun:
                partner.forget()

    def _note_step(self, partner: Partner, step: Step) -> None:
        self._check_cycle(partner, step.cycle_ns)
        flags = step.head.flags
        if not flags & StepFlag.OVER and self._rack not in step.racks:
            self._refuse(
                f"rack '{partner.rack}' does not wait for '{self._rack}' in lockstep: name it in"
                " adapter.lan.peers there, and start all racks anew"
            )
        time_ns = step.head.time_ns
        if not self._has_begun and partner.time_ns == NEVER and time_ns > self._now_ns:
            self._refuse(
                f"rack '{partner.rack}' is at {time_ns * 1e-9:g} s already: racks in lockstep"
                " begin together, start all anew"
            )
        partner.take(step)
        if partner.is_out and flags & StepFlag.FIRST and not self._has_begun:
            # Neither has begun: it may be started again.
            partner.forget()
        elif flags & StepFlag.FIRST:
            # Before this rack goes on: it may come too late for the other one to have received its
            # step.
            self._send_again(StepFlag(0))

    def _is_of(self, partner: Partner, launch: int) -> bool:
        """Say whether a launch is the one that steps with this rack; one that comes later takes no
        part.
        """
        if partner.launch != launch:
            if self._has_begun and partner.launch != NONE:
                partner.is_out = True
                return False
            partner.forget()
            partner.launch = launch
        return True

    def _check_cycle(self, partner: Partner, cycle_ns: int) -> None:
        if not cycle_ns:
            self._refuse(f"rack '{partner.rack}' runs in real time, this one in lockstep")
        if cycle_ns != self.cycle_ns:
            self._refuse(
                f"cycles of adapter.lan differ: {cycle_ns * 1e-6:g} ms in rack '{partner.rack}', "
                f"{self.cycle_ns * 1e-6:g} ms here; lockstep needs equal ones"
            )

    def _refuse(self, why: str) -> NoReturn:
        self._has_refused = True
        raise CannotGoOn(why)

    def _pass_on(self, partner: Partner) -> None:
        """Pass on what a rack has exported up to now, and whether it is there."""
        for step in partner.passed(self._now_ns):
            # What comes once more after a restart was passed on before it.
            for export in step.exports if step.head.time_ns > self._passed_ns else ():
                if export.key.split("/")[1] == partner.rack and export.key in self._imports:
                    self._imports[export.key].append(export)
        is_there = partner.time_ns >= self._now_ns
        if is_there != partner.is_there or self._is_first:
            partner.is_there = is_there
            self._changes.append((partner.rack, partner.launch, is_there))
