"""Lockstep of several racks: a cycle of an adapter ends when that cycle has begun in all racks.

In the cycle released at simulated time t, an adapter sends its step: the time t and everything that
its rack exports in this cycle. It waits for the step of time t from every other rack, then delivers
what they have exported up to t. A message becomes visible at the end of its cycle, so nobody needs
a later step, and the imports depend on ticks alone. No clock can be more than two of these cycles
ahead of another. If one rack is held, all are.

Exports travel within the step. A cycle therefore costs one message, and the order of messages does
not matter. Alternatives considered: a mark after the exports (each export costs a message, and the
network keeps the order only within one key), a barrier in the clock at every tick (the clock would
wait for the network even if no message is due; an adapter at the rate of the clock has the same
effect), and one rack that steps the others (one more process on which all depend).

A step that somebody may have missed is sent again: to a rack that appears, and to an adapter that
sends its first step. A rack whose adapter has died is awaited, because its board may be restarted.
A rack that ends says so, and counts as lost from the next cycle on.
"""

from __future__ import annotations

import math
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
from rack.boards.lan.awaited import GIVE_UP_S, WaitReason, encode_wait
from rack.boards.lan.envelope import MAX_MESSAGE_BYTES, Envelope, Flaw
from rack.boards.lan.keys import ALL_ALIVE, parse_alive_key, step_key
from rack.boards.lan.link import LanLink, ReceivedMessage
from rack.boards.lan.peers import NO_LAUNCH
from rack.levels.errors import CannotGoOn

STEP_KIND = xxh3(b"rack step 2")
_CONTENT: Any = tuple[Int64, list[str], list[tuple[str, bytes, bytes]]]
"""Length of the cycle in ns, racks, and key, envelope and payload of each export."""


class StepFlag(IntFlag):
    """Flags in the envelope of a step."""

    FIRST = 1  # the sender has just started and needs the newest step of the others
    OVER = 2  # the sender's run has ended with this step


class Step(NamedTuple):
    """Message that a rack sends to the others in each cycle in lockstep.

    Attributes:
        head: Envelope of the step.
        cycle_ns: Length of the adapter's cycle in ns of simulated time.
        racks: Racks for which the sender waits.
        exports: Messages that the sender exports in this cycle.
    """

    head: Envelope
    cycle_ns: int
    racks: list[str]
    exports: list[ReceivedMessage]


def pack_step(cycle_ns: int, racks: Iterable[str], exports: Sequence[ReceivedMessage]) -> bytes:
    """Serialise the content of a step.

    Args:
        cycle_ns: Length of the adapter's cycle in ns of simulated time.
        racks: Racks for which the sender waits.
        exports: Messages to export.
    """
    parts = [(export.key, export.envelope or b"", export.payload) for export in exports]
    return z_serialize((Int64(cycle_ns), list(racks), parts)).to_bytes()


def unpack_step(head: Envelope, content: bytes) -> Step | None:
    """Parse the content of a step. Return None if it is malformed or not a step."""
    if head.kind != STEP_KIND:
        return None
    try:
        cycle_ns, racks, export_tuples = z_deserialize(_CONTENT, zenoh.ZBytes(content))
    except ZDeserializeError:
        return None
    exports = [ReceivedMessage(*export) for export in export_tuples]
    # The deserialiser ignores trailing bytes. To detect them, pack the step again and compare.
    if pack_step(cycle_ns, racks, exports) != content:
        return None
    return Step(head, cycle_ns, racks, exports)


CHECK_INTERVAL_S = 0.1
"""Interval at which a waiting adapter checks for the end of the run and for lost racks."""
NEVER = -1


class Partner:
    """State of a rack that runs in lockstep with this one.

    Attributes:
        rack: Name of the rack.
        place: Index of the rack in `LanTable.racks`.
        launch: Launch that sends its steps. `NO_LAUNCH` if none is known.
        time_ns: Simulated time of its newest step in ns. `NEVER` if none has arrived.
        steps: Steps whose exports are not yet delivered.
        is_out: Whether the rack no longer takes part, so that nobody waits for it.
        is_present: Whether the rack was present in the last cycle.
        gone_s: CLOCK_MONOTONIC time in s at which the end of its adapter was noticed. None if the
            adapter is present or was never seen.
    """

    def __init__(self, rack: str, place: int) -> None:
        self.rack = rack
        self.place = place
        self.reset_state()

    def reset_state(self) -> None:
        """Reset to the initial state, in which this rack waits for the other one."""
        self.launch = NO_LAUNCH
        self.time_ns = NEVER
        self.steps: deque[Step] = deque()
        self.is_out = self.is_present = False
        self.gone_s: float | None = None

    @property
    def wait_word(self) -> int:
        """Word for `Block.AWAITS` that identifies this rack and the reason for waiting."""
        why = WaitReason.UNSEEN if self.launch == NO_LAUNCH else WaitReason.SLOWER
        return encode_wait(self.place, why if self.gone_s is None else WaitReason.GONE)

    def add_step(self, step: Step) -> None:
        """Store a step if it is newer than all earlier ones. Update `is_out` from its flags."""
        self.gone_s = None
        if step.head.time_ns > self.time_ns:
            self.time_ns = step.head.time_ns
            self.steps.append(step)
        self.is_out = bool(step.head.flags & StepFlag.OVER)


class Barrier:
    """Exchanges the steps of all racks in lockstep at the end of each cycle.

    Exports and imports use it in place of `LanLink`: it has the same `publish` and `subscribe`.

    Attributes:
        cycle_ns: Length of the adapter's cycle in ns of simulated time. It must be equal in all
            racks.
        last_done_tick: Release tick of the last cycle that the previous adapter finished. -1 if
            there was none.
    """

    def __init__(
        self, segment: Segment, board: str, racks: Iterable[str], lost: Iterable[str]
    ) -> None:
        """Create the barrier of an adapter.

        Args:
            segment: Segment of the rack.
            board: Board of the adapter.
            racks: Racks with which to run in lockstep.
            lost: Racks that were lost before this adapter was restarted. They do not take part.
        """
        self._segment = segment
        self._block = segment.get_block(board)
        self._partners = {rack: Partner(rack, place) for place, rack in enumerate(racks)}
        for rack in lost:
            self._partners[rack].is_out = True
        self._tick_ns = segment.layout.clock_ns
        self.cycle_ns = segment.layout.find_task(board).every * self._tick_ns
        self.last_done_tick = self._block[Block.DONE]
        self._has_begun = self.last_done_tick >= 0
        # Exports up to this time were delivered before the restart and are not delivered again.
        self._passed_ns = self.last_done_tick * self._tick_ns if self._has_begun else NEVER
        self._is_first = True
        self._has_refused = False
        self._block[Block.AWAITS] = 0
        self._exports: list[ReceivedMessage] = []
        self._imports: dict[str, deque[ReceivedMessage]] = {}
        self._changes: list[tuple[str, int, bool]] = []
        # Keep two steps: another rack can lack at most the newest two.
        self._steps: deque[tuple[int, bytes]] = deque(maxlen=2)
        self._now_ns = NEVER
        self._sent = 0
        self._events: SimpleQueue[zenoh.Sample] = SimpleQueue()
        self._subscribers: list[object] = []

    def open(self, link: LanLink, launch: int) -> None:
        """Start to receive steps. Call it before the token of this launch is declared."""
        self._rack = link.rack
        self._launch = launch
        self._sealer = link.sealer
        self._key = step_key(link.rack)
        self._put = link.publish(self._key, reliable=True)
        # The handler is called in a thread of zenoh, so it only queues the sample.
        handler = zenoh.handlers.Callback(self._events.put, indirect=False)
        for partner in self._partners.values():
            self._subscribers.append(
                link.session.declare_subscriber(step_key(partner.rack), handler)
            )
            if self._has_begun:
                # The other adapter may have ended while this one was restarted.
                partner.gone_s = time.monotonic()
        self._subscribers.append(
            link.session.liveliness().declare_subscriber(ALL_ALIVE, handler, history=True)
        )

    def publish(self, key: str) -> Callable[[bytes, bytes], None]:
        """Return a function that adds a payload and its envelope to the next step message."""
        return lambda payload, envelope: self._exports.append(
            ReceivedMessage(key, envelope, payload)
        )

    def subscribe(self, key: str) -> Callable[[], Iterator[ReceivedMessage]]:
        """Return a function that yields the messages delivered under a key since its last call."""
        waiting = self._imports.setdefault(key, deque())
        return lambda: (waiting.popleft() for _ in range(len(waiting)))

    def take_changes(self) -> Iterator[tuple[str, int, bool]]:
        """Yield each change of presence since the last call, as (rack, launch, is present)."""
        changes = self._changes
        self._changes = []
        yield from changes

    def prepare_step(self, tick: int) -> None:
        """Pack the messages exported since the previous step into the step message of this cycle.

        Raises:
            CannotGoOn: The step message is too long.
        """
        awaited = [partner.rack for partner in self._partners.values() if not partner.is_out]
        content = pack_step(self.cycle_ns, awaited, self._exports)
        self._exports = []
        if len(content) > MAX_MESSAGE_BYTES:
            self._refuse_lockstep(
                f"a cycle exports {len(content)} bytes; in lockstep at most "
                f"{MAX_MESSAGE_BYTES} are allowed"
            )
        self._steps.append((tick * self._tick_ns, content))

    def exchange_steps(self, tick: int) -> bool:
        """Send the step message of this cycle and wait for those of all other racks.

        Returns:
            False if the run ended during the wait.

        Raises:
            CannotGoOn: Another rack cannot run in lockstep with this one.
        """
        self._now_ns = now_ns = tick * self._tick_ns
        self.prepare_step(tick)
        if self._is_first:
            self._resend_steps(StepFlag.FIRST)
        else:
            self._send_step(*self._steps[-1], StepFlag(0))
        while late_partners := [
            partner
            for partner in self._partners.values()
            if partner.time_ns < now_ns and not partner.is_out
        ]:
            try:
                self._process_sample(self._events.get(timeout=CHECK_INTERVAL_S))
            except Empty:
                if self._is_over:
                    return False
                # Show which rack is awaited. Stop waiting if its adapter has been gone too long.
                awaited = late_partners[0]
                self._block[Block.AWAITS] = awaited.wait_word
                gone_s = time.monotonic() - (awaited.gone_s or math.inf)
                awaited.is_out |= gone_s > GIVE_UP_S
        self._block[Block.AWAITS] = 0
        for partner in self._partners.values():
            self._deliver_exports(partner)
        self._is_first = False
        self._has_begun = True
        return True

    def close(self) -> None:
        """If the run has ended or lockstep was refused, tell other racks not to wait for this one.

        Nothing is sent if only this board ends, because it may be restarted.
        """
        if self._steps and (self._is_over or self._has_refused):
            self._send_step(*self._steps[-1], StepFlag.OVER | self._first_flag)

    def _send_step(self, time_ns: int, content: bytes, flags: StepFlag) -> None:
        """Seal and send the packed step of simulated time `time_ns`."""
        self._sent += 1
        tick = time_ns // self._tick_ns
        head = Envelope(
            STEP_KIND, self._launch, self._sent, self._sent, tick, time_ns, time_ns, flags
        )
        self._put(content, self._sealer.seal(self._key, head, content))

    def _resend_steps(self, flags: StepFlag) -> None:
        """Send the last two steps again for a rack that may have missed them.

        Racks that have received these steps ignore them.
        """
        for time_ns, content in self._steps:
            self._send_step(time_ns, content, flags)

    @property
    def _first_flag(self) -> StepFlag:
        """Flag `FIRST` until the first exchange of steps is complete, afterwards 0."""
        return StepFlag.FIRST if self._is_first else StepFlag(0)

    @property
    def _is_over(self) -> bool:
        """Whether the run is over, or its end has been requested."""
        return bool(self._segment.words[System.STOP_REQUEST]) or self._segment.run_is_over

    def _process_sample(self, sample: zenoh.Sample) -> None:
        """Process a received sample, which is a step or a change of a liveliness token."""
        key = str(sample.key_expr)
        partner = self._partners.get(key.split("/")[1])
        if partner is None or partner.is_out:
            return
        if key != step_key(partner.rack):
            if (parsed := parse_alive_key(key)) is not None:
                self._process_token(partner, *parsed, sample.kind == zenoh.SampleKind.PUT)
            return
        arrived = ReceivedMessage.from_sample(sample)
        head = self._sealer.open_message(*arrived)
        step = None if isinstance(head, Flaw) else unpack_step(head, arrived.payload)
        if step is not None and self._is_partner_launch(partner, step.head.launch):
            self._process_step(partner, step)

    def _process_token(
        self, partner: Partner, launch: int, cycle_ns: int, is_present: bool
    ) -> None:
        """Process a change of another rack's liveliness token.

        If the token has appeared, resend this rack's newest steps. If it has expired, start the
        time-out after which the rack is considered lost.
        """
        if is_present and partner.launch in (NO_LAUNCH, launch):
            self._check_cycle(partner, cycle_ns)
            partner.gone_s = None
            # The rack has just appeared, so it has missed the steps that were sent before.
            self._resend_steps(self._first_flag)
        elif is_present:
            self._is_partner_launch(partner, launch)
        elif partner.launch == launch:
            partner.gone_s = time.monotonic()
            if not self._has_begun:
                partner.reset_state()

    def _process_step(self, partner: Partner, step: Step) -> None:
        """Store a step of another rack. Resend this rack's steps if the other one has just started.

        Raises:
            CannotGoOn: The racks cannot run in lockstep.
        """
        self._check_cycle(partner, step.cycle_ns)
        flags = step.head.flags
        if not flags & StepFlag.OVER and self._rack not in step.racks:
            self._refuse_lockstep(
                f"rack '{partner.rack}' does not wait for '{self._rack}' in lockstep: name it in"
                " adapter.lan.peers there, and restart all racks"
            )
        time_ns = step.head.time_ns
        if not self._has_begun and partner.time_ns == NEVER and time_ns > self._now_ns:
            self._refuse_lockstep(
                f"rack '{partner.rack}' is already at {time_ns * 1e-9:g} s: racks in lockstep"
                " must begin together; restart all racks"
            )
        partner.add_step(step)
        if partner.is_out and flags & StepFlag.FIRST and not self._has_begun:
            # Neither run has begun, so the other rack may be launched again.
            partner.reset_state()
        elif flags & StepFlag.FIRST:
            # The other rack may have started too late to receive the step of this cycle. Repeat it
            # before this rack continues.
            self._resend_steps(StepFlag(0))

    def _is_partner_launch(self, partner: Partner, launch: int) -> bool:
        """Return True if a launch of another rack may take part.

        Until the run begins, a new launch replaces the previous one. Later it cannot replace it,
        and the rack no longer takes part.
        """
        if partner.launch != launch:
            if self._has_begun and partner.launch != NO_LAUNCH:
                partner.is_out = True
                return False
            partner.reset_state()
            partner.launch = launch
        return True

    def _check_cycle(self, partner: Partner, cycle_ns: int) -> None:
        """Raise `CannotGoOn` if the other rack runs in real time or with another cycle length."""
        if not cycle_ns:
            self._refuse_lockstep(f"rack '{partner.rack}' runs in real time, this one in lockstep")
        if cycle_ns != self.cycle_ns:
            self._refuse_lockstep(
                f"cycles of adapter.lan differ: {cycle_ns * 1e-6:g} ms in rack '{partner.rack}', "
                f"{self.cycle_ns * 1e-6:g} ms in this rack; they must be equal in lockstep"
            )

    def _refuse_lockstep(self, why: str) -> NoReturn:
        """Raise `CannotGoOn`, which ends this board, with the reason why lockstep is impossible."""
        self._has_refused = True
        raise CannotGoOn(why)

    def _deliver_exports(self, partner: Partner) -> None:
        """Deliver a rack's exports up to this cycle, and record a change of its presence."""
        while partner.steps and partner.steps[0].head.time_ns <= self._now_ns:
            step = partner.steps.popleft()
            # Skip steps that were delivered before this adapter was restarted. They arrive again.
            for export in step.exports if step.head.time_ns > self._passed_ns else ():
                if export.key.split("/")[1] == partner.rack and export.key in self._imports:
                    self._imports[export.key].append(export)
        is_present = partner.time_ns >= self._now_ns
        if is_present != partner.is_present or self._is_first:
            partner.is_present = is_present
            self._changes.append((partner.rack, partner.launch, is_present))
