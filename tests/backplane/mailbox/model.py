"""A model of the mailbox's protocol: all that may happen between a writer and its readers.

The writer may be killed before each of its accesses to shared memory, and has successors. `explore`
visits every state that an interleaving leads to, breadth first, and checks in each:

- A reader returns only messages that were published, each as it was published, in order.
- No reader takes a published message for a damaged or a forged one.
- Each message is published under the claim that is valid: there is one at a time.
- A writer that is stopped may be replaced while it lives. It still makes the stores of one
  publication, at any time, and no reader returns that message once its claim is not valid any more.
  It may set the head to where its successor works: a complete message of that is then as good as
  published.
- Nobody waits: each process can always take its next step.

Three memories: sequential consistency (SC); x86-TSO, where stores wait in a buffer, first in, first
out; and weak memory, where accesses take effect in any order that acquire, release and fences
permit, and loads are speculated. Copies access their words in any order under all three. Memory is
one for all: a store becomes visible to all others at once, as on x86-64 and ARMv8. What a dead
writer has stored is visible before its successor begins, which gets the kernel's lock from it.

`PUBLISH`, `LOSE`, `CLAIM`, `TAKE_OVER`, `READ` and `JUDGE` are the accesses of the code, in order;
test_model.py compares them with those that the code makes. A reader chooses any message that it may
find visible; so the model covers reads by ticks, of the newest message, and those that step back.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

PUBLISH = ("fence", "store message", "fence", "store signature", "fence", "store head")
LOSE = ("fence", "store head")
CLAIM = ("store begun", "fence", "store claim", "clear slot")
TAKE_OVER = (
    *("store begun", "fence", "store claim", "fence"),
    *("load head", "store begun", "clear slot"),
)
READ = ("load head", "fence", "load signature", "fence", "load message", "fence", "load claim")
FORMER = ("fence", "load begun")
"""Further accesses by which a reader checks a message of an earlier epoch than that of the claim.
The model makes them together with the load of the claim: what a word contains does not change while
its epoch, or the one after it, is the newest."""
JUDGE = ("fence", "load head")
"""Accesses by which a reader learns whether a slot was reused while it was copied."""
SIGNATURE = "e"
EMPTY = 0
EPOCHS = 8
"""A message is a number: its serial times this, and the epoch of its writer."""


class Memory(Enum):
    """How accesses of one process become visible to others."""

    SC = "sequential consistency"
    TSO = "x86-TSO"
    WEAK = "weak stores and loads"


@dataclass(frozen=True)
class Setup:
    """Bounds and variants of the exploration.

    Attributes:
        memory: Order of accesses.
        depth: Slots of the ring.
        published: Messages that exist at the beginning.
        messages: Maximum number of messages published after that.
        kills: Maximum number of times that the writer is killed.
        stops: Maximum number of times that the writer is stopped, and replaced while it lives.
        losses: Maximum number of serials published without a message.
        forgeries: Maximum number of messages published by a process without the claim. Each is
            published at once, and not while the writer publishes.
        readers: Number of readers.
        reads: Reads of each reader.
        words: Words of a slot: e, epoch of the writer; s, serial; p, content; c, checksum.
            Words of one group are copied together.
        publish: Accesses of a writer that publishes a message.
        lose: Accesses of a writer that publishes a serial without its message.
        claim: Accesses of a writer that begins. With stops, `TAKE_OVER` is what the code does.
        read: Accesses of a reader that takes a message.
        judge: Accesses of a reader after a bad copy.
        is_checked: True if a reader checks the checksum.
        is_claimed: True if a reader checks the writer.
        is_bound: True if the checksum is combined with the epoch of the writer.
        is_bounded: True if a reader compares serials of earlier epochs with the words of `FORMER`.
        is_claim_loaded: True if a reader loads the claim even if it knows the writer.
        is_locked: True if a writer begins only after its predecessor is dead.
        waits: True if a reader waits while its slot is being filled.
    """

    memory: Memory = Memory.SC
    depth: int = 4
    published: int = 3
    messages: int = 5
    kills: int = 1
    stops: int = 0
    losses: int = 0
    forgeries: int = 0
    readers: int = 1
    reads: int = 1
    words: tuple[str, ...] = (SIGNATURE, "s", "p", "c")
    publish: tuple[str, ...] = PUBLISH
    lose: tuple[str, ...] = LOSE
    claim: tuple[str, ...] = CLAIM
    read: tuple[str, ...] = READ
    judge: tuple[str, ...] = JUDGE
    is_checked: bool = True
    is_claimed: bool = True
    is_bound: bool = True
    is_bounded: bool = True
    is_claim_loaded: bool = True
    is_locked: bool = True
    waits: bool = False


class Store(NamedTuple):
    """A store that a writer has not made yet."""

    place: str  # "head", "claim", "begun" or "slot"
    value: int
    slot: int = 0
    word: int = 0
    section: int = 0  # number of fences before it
    publication: int = 0  # serial; 0: of a writer that begins
    access: int = 0  # number of the access in its publication


class Writer(NamedTuple):
    """A writer: the stores that it has still to make, in program order."""

    epoch: int
    issued: int  # newest serial whose stores are among these, or made
    stores: tuple[Store, ...]
    claims_after: int = 0  # epoch of the writer whose newest message it still has to load again
    buffer: tuple[Store, ...] = ()  # under TSO: made, and not yet visible
    is_alive: bool = True
    is_stopped: bool = False


class Reader(NamedTuple):
    """A reader, between reads or in one."""

    last: int  # serial of the newest message returned
    known: int  # epoch of its writer
    reads: int  # left
    serial: int = 0  # that it copies; 0: between reads
    has_head: bool = False
    copied: tuple[int, ...] = ()  # messages of which it has copied the words; -1: none yet
    claim: int = -1  # as it has found it; -1: not yet
    begun: tuple[int, ...] = ()  # as it has found it, with the claim
    head: int = -1  # as it has found it after the copy; -1: not yet


class State(NamedTuple):
    """All of shared memory, and every process."""

    head: int
    claim: int
    begun: tuple[int, ...]  # serial of the newest message when an epoch began, by epoch
    slots: tuple[tuple[int, ...], ...]
    # Of the writers of all published messages: of none of a serial that is forged or lost, of two
    # if a successor was killed before it had found what a stopped writer published.
    epochs: tuple[tuple[int, ...], ...]
    writers: tuple[Writer, ...]
    readers: tuple[Reader, ...]
    kills: int
    stops: int
    losses: int
    forgeries: int


class Violation(Exception):
    """A state that must not be."""


class Exploration(NamedTuple):
    """The number of states, and the violation found, with the way to it; none if that is empty."""

    states: int
    violation: str
    steps: tuple[str, ...]


def explore(setup: Setup) -> Exploration:
    """Visit all states, up to the first violation."""
    model = _Model(setup)
    start = model.start()
    before: dict[State, tuple[State, str] | None] = {start: None}
    level = [start]
    while level:
        found = []
        for state in level:
            try:
                for step, after in model.steps(state):
                    if after not in before:
                        before[after] = state, step
                        found.append(after)
            except Violation as violation:
                return Exploration(len(before), str(violation), _way(before, state))
        level = found
    return Exploration(len(before), "", ())


def _way(before: dict[State, tuple[State, str] | None], state: State) -> tuple[str, ...]:
    steps = []
    while (last := before[state]) is not None:
        state, step = last
        steps.append(step)
    return tuple(reversed(steps))


class _Model:
    """The steps from each state."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._is_weak = setup.memory is Memory.WEAK
        self._last = setup.published + setup.messages
        self._ahead = 2 if self._is_weak else 1  # publications that a writer works on at once
        at = {letter: number for number, word in enumerate(setup.words) for letter in word}
        self._epoch, self._serial, self._content, self._check = (at[letter] for letter in "espc")
        # Without acquire a reader may copy what it guesses that it will find.
        self._is_speculated = self._is_unordered(setup.read, "load head", "load signature")
        self._is_signed_early = not self._is_unordered(setup.read, "load signature", "load message")
        self._is_claim_early = self._is_unordered(setup.read, "load message", "load claim")
        # Without a fence it may know the head early.
        self._is_early = self._is_weak and "fence" not in setup.judge

    def _is_unordered(self, accesses: Sequence[str], first: str, second: str) -> bool:
        """Check whether the second of two loads may come before the first."""
        start, end = accesses.index(first), accesses.index(second)
        return end < start or (self._is_weak and "fence" not in accesses[start:end])

    def start(self) -> State:
        """Return the first state: some messages are there, and the readers know the newest."""
        setup = self._setup
        slots = [(EMPTY,) * len(setup.words)] * setup.depth
        for serial in range(1, setup.published + 1):
            slots[serial % setup.depth] = (serial * EPOCHS + 1,) * len(setup.words)
        return State(
            head=setup.published,
            claim=1,
            begun=(0,) * EPOCHS,
            slots=tuple(slots),
            epochs=((1,),) * (setup.published + 1),
            writers=(Writer(1, setup.published, ()),),
            readers=(Reader(setup.published, 1, setup.reads),) * setup.readers,
            kills=setup.kills,
            stops=setup.stops,
            losses=setup.losses,
            forgeries=setup.forgeries,
        )

    def steps(self, state: State) -> Iterator[tuple[str, State]]:
        """Yield every step that a process can take, and the state after it. Raises `Violation`."""
        for at, writer in enumerate(state.writers):
            yield from self._writer_steps(state, at, writer)
        yield from self._begin(state)
        if state.forgeries and not any(self._is_publishing(one) for one in state.writers):
            yield "forge", self._forged(state)
        for at, reader in enumerate(state.readers):
            is_moving = False
            for step, after in self._reader_steps(state, reader):
                is_moving = True
                readers = (*state.readers[:at], after, *state.readers[at + 1 :])
                # It is the same which of two readers has done what.
                yield step, state._replace(readers=tuple(sorted(readers)))
            if not is_moving and (reader.reads or reader.serial):
                raise Violation("a reader waits")

    # The writer

    def _writer_steps(self, state: State, at: int, writer: Writer) -> Iterator[tuple[str, State]]:
        def moved(after: Writer, of: State = state) -> State:
            return of._replace(writers=(*of.writers[:at], after, *of.writers[at + 1 :]))

        for store, buffer in self._next(writer.buffer):
            stored = self._stored(state, store, writer)
            yield f"seen: {store}", moved(writer._replace(buffer=buffer), stored)
        if not writer.is_alive:
            return
        if not writer.is_stopped:
            for step, after, changed in self._turns(state, writer):
                yield step, moved(after)._replace(**changed)
            if writer.claims_after and not (writer.stores or writer.buffer):
                head, found = self._find_newest(state, writer.claims_after)
                rest = self._list_claim_stores(state, writer.epoch, head, is_second=True)
                after = writer._replace(issued=head, stores=rest, claims_after=0)
                yield "load head again", moved(after, found)
            writer = self._continued(writer)
        if self._setup.memory is Memory.TSO:
            for store in writer.stores[:1]:
                after = writer._replace(stores=writer.stores[1:], buffer=(*writer.buffer, store))
                yield f"store: {store}", moved(after)
        else:
            for store, stores in self._next(writer.stores):
                stored = self._stored(state, store, writer)
                yield f"store: {store}", moved(writer._replace(stores=stores), stored)

    def _turns(self, state: State, writer: Writer) -> Iterator[tuple[str, Writer, dict[str, int]]]:
        """Yield what may happen to a writer: it loses a message, is stopped or is killed."""
        if state.losses and self._may_issue(writer):
            losing = self._issued(writer, self._setup.lose)
            yield f"lose {losing.issued}", losing, {"losses": state.losses - 1}
        writer = self._continued(writer)
        # A process that is stopped while it claims keeps others from taking over.
        is_claiming = writer.claims_after or not all(
            store.publication for store in (*writer.stores, *writer.buffer)
        )
        if state.stops and not is_claiming:
            yield "stop the writer", self._stopped(writer), {"stops": state.stops - 1}
        if state.kills:
            dead = Writer(writer.epoch, 0, (), writer.buffer, is_alive=False)
            yield "kill the writer", dead, {"kills": state.kills - 1}

    def _stopped(self, writer: Writer) -> Writer:
        """Return a stopped writer, which still makes the stores of the publication it works on."""
        first = min((store.publication for store in writer.stores), default=0)
        left = tuple(store for store in writer.stores if store.publication == first)
        return writer._replace(stores=left, is_stopped=True)

    def _next(self, stores: tuple[Store, ...]) -> Iterator[tuple[Store, tuple[Store, ...]]]:
        """Yield each store that may be the next to take effect, and the others."""
        for number, store in enumerate(stores):
            if not any(self._is_before(one, store) for one in stores[:number]):
                yield store, stores[:number] + stores[number + 1 :]

    def _may_issue(self, writer: Writer) -> bool:
        """Check whether a writer may begin with one more publication."""
        begun = {store.publication for store in writer.stores} - {0}
        return not writer.claims_after and writer.issued < self._last and len(begun) < self._ahead

    def _continued(self, writer: Writer) -> Writer:
        """Return the writer with the stores of all publications that it may work on."""
        while self._may_issue(writer):
            writer = self._issued(writer, self._setup.publish)
        return writer

    def _issued(self, writer: Writer, accesses: Sequence[str]) -> Writer:
        """Return the writer with the stores of one publication more."""
        setup = self._setup
        serial = writer.issued + 1
        message = serial * EPOCHS + writer.epoch
        section = serial * setup.publish.count("fence")
        stores = list(writer.stores)
        for number, access in enumerate(accesses):
            common = {"section": section, "publication": serial, "access": number}
            slot = serial % setup.depth
            match access:
                case "fence":
                    section += 1
                case "store message":
                    stores += [
                        Store("slot", message, slot, word, **common)
                        for word in range(len(setup.words))
                        if word != self._epoch
                    ]
                case "store signature":
                    stores.append(Store("slot", message, slot, self._epoch, **common))
                case "store head":
                    stores.append(Store("head", serial, **common))
                case "store claim":
                    stores.append(Store("claim", writer.epoch, **common))
        return writer._replace(issued=serial, stores=tuple(stores))

    def _is_before(self, earlier: Store, later: Store) -> bool:
        """Check whether the memory keeps two stores of a program in order."""
        if self._is_weak:
            is_same = earlier[:1] + earlier[2:4] == later[:1] + later[2:4]
            return is_same or earlier.section < later.section
        # The words of one copy are stored in any order.
        return earlier[-2:] != later[-2:]

    def _stored(self, state: State, store: Store, writer: Writer) -> State:
        """Return the state with a store of a writer in memory. Raises `Violation`."""
        is_lawful = state.claim == writer.epoch
        match store.place:
            case "claim":
                return state._replace(claim=store.value)
            case "begun":
                begun = list(state.begun)
                begun[writer.epoch] = store.value
                return state._replace(begun=tuple(begun))
            case "slot":
                words = list(state.slots[store.slot])
                words[store.word] = store.value
                slots = list(state.slots)
                slots[store.slot] = tuple(words)
                epochs = list(state.epochs)
                serial = store.value // EPOCHS
                if is_lawful and set(words) == {store.value} and 0 < serial <= state.head:
                    # It takes the place of a forged message, or of one of a stopped writer.
                    before = [one for one in epochs[serial] if one != writer.epoch]
                    epochs[serial] = (*before, writer.epoch)
                return state._replace(slots=tuple(slots), epochs=tuple(epochs))
        epochs = [*state.epochs, ()][: max(len(state.epochs), store.value + 1)]
        before = epochs[store.value]
        if is_lawful:
            epochs[store.value] = (*(one for one in before if one != writer.epoch), writer.epoch)
        elif writer.is_stopped:
            # It sets the head back, or to the serial on which its successor works.
            words = state.slots[store.value % self._setup.depth]
            if set(words) == {store.value * EPOCHS + state.claim} and state.claim not in before:
                epochs[store.value] = (*before, state.claim)
        else:
            raise Violation("a message is published without the valid claim")
        return state._replace(head=store.value, epochs=tuple(epochs))

    def _begin(self, state: State) -> Iterator[tuple[str, State]]:
        """Start a successor of the last writer."""
        *_, last = state.writers
        setup = self._setup
        is_gone = not last.is_alive and not last.buffer
        if not (is_gone or last.is_stopped or not setup.is_locked):
            return
        # A writer that was killed before it stored its claim has used no epoch.
        if (state.claim if is_gone else last.epoch) > setup.kills + setup.stops:
            return
        epoch = state.claim + 1
        head, state = self._find_newest(state, state.claim)
        stores = self._list_claim_stores(state, epoch, head)
        after = state.claim if "load head" in setup.claim else 0
        # What the dead one has left is in memory by now.
        others = () if is_gone else state.writers
        writer = Writer(epoch, head, stores, after)
        yield f"begin, epoch {epoch}", state._replace(writers=(*others, writer))

    def _find_newest(self, state: State, claim: int) -> tuple[int, State]:
        """Return the serial after which a successor continues, as `Slots.find_newest` does.

        Args:
            state: State of memory.
            claim: Epoch of the writer before.

        Returns:
            The serial; and the state, in which all messages up to it are published.
        """
        setup = self._setup
        head = state.head
        if "load head" not in setup.claim:
            return head, state
        begun = state.begun[claim]
        head = max(head, begun)
        own = [
            words[self._serial] // EPOCHS
            for words in state.slots
            if words[self._epoch] and words[self._epoch] % EPOCHS == claim
        ]
        newest = max(own, default=begun)
        words = state.slots[head % setup.depth]
        is_lost = words[self._serial] // EPOCHS == head - setup.depth
        is_lost = is_lost and (words[self._serial] > 0 or not words[self._epoch])
        if newest > head + 1 or (newest < head and not is_lost):
            head = newest
        epochs = [*state.epochs, *[()] * (head + 1 - len(state.epochs))]
        for serial in range(max(1, head - setup.depth + 1), head + 1):
            signature = state.slots[serial % setup.depth][self._epoch]
            # Another stopped writer may have damaged it since.
            if signature == serial * EPOCHS + claim and claim not in epochs[serial]:
                epochs[serial] = (*epochs[serial], claim)
        return head, state._replace(epochs=tuple(epochs))

    def _list_claim_stores(
        self, state: State, epoch: int, head: int, is_second: bool = False
    ) -> tuple[Store, ...]:
        """Return the stores of a claim.

        Args:
            state: State of memory.
            epoch: Epoch of the writer.
            head: Serial after which it continues.
            is_second: True for those after the head was loaded again.
        """
        accesses = self._setup.claim
        again = accesses.index("load head") if "load head" in accesses else len(accesses)
        stores: list[Store] = []
        section = 0
        for number, access in enumerate(accesses):
            common = {"section": section, "access": number}
            if access == "fence":
                section += 1
            elif (number > again) != is_second:
                continue
            elif access == "store begun":
                stores.append(Store("begun", head, **common))
            elif access == "store claim":
                stores.append(Store("claim", epoch, **common))
            elif access == "clear slot":
                stores += [
                    Store("slot", EMPTY, at, self._serial, **common)
                    for at, words in enumerate(state.slots)
                    if words[self._serial] // EPOCHS > head
                ]
        return tuple(stores)

    def _is_publishing(self, writer: Writer) -> bool:
        """Check whether a writer has made some of the stores of a publication."""
        whole = (0, len(self._setup.words) + 1)
        return bool(writer.buffer) or len(writer.stores) not in whole

    def _forged(self, state: State) -> State:
        """Return the state after a process without the claim has published: its epoch is 0."""
        serial = state.head + 1
        slots = list(state.slots)
        slots[serial % self._setup.depth] = (serial * EPOCHS,) * len(self._setup.words)
        return state._replace(
            head=serial,
            slots=tuple(slots),
            epochs=(*state.epochs[:serial], ()),
            forgeries=state.forgeries - 1,
        )

    # The readers

    def _reader_steps(self, state: State, reader: Reader) -> Iterator[tuple[str, Reader]]:
        if not reader.serial:
            if reader.reads:
                yield from self._begin_read(state, reader)
            return
        if not reader.has_head:
            first, last = self._choice(reader, state.head)
            if first <= reader.serial <= last:
                yield "find the head", self._concluded(state, reader._replace(has_head=True))
            else:
                yield "guess wrongly", self._ended(reader)
        slot = state.slots[reader.serial % self._setup.depth]
        if self._setup.waits and len(set(slot)) > 1:
            return
        is_signed = not self._is_signed_early or reader.copied[self._epoch] >= 0
        for word, message in enumerate(reader.copied):
            if message < 0 and (is_signed or word == self._epoch):
                copied = (*reader.copied[:word], slot[word], *reader.copied[word + 1 :])
                after = self._concluded(state, reader._replace(copied=copied))
                yield f"load word {word} of slot {reader.serial % self._setup.depth}", after
        is_whole = min(reader.copied) >= 0
        if reader.claim < 0 and (self._is_claim_early or (is_whole and self._is_good(reader))):
            known = reader._replace(claim=state.claim, begun=state.begun)
            after = self._concluded(state, known)
            yield "load claim", after
        if reader.head < 0 and reader.has_head and (self._is_early or self._is_bad(reader)):
            after = self._concluded(state, reader._replace(head=state.head))
            yield "load head again", after

    def _begin_read(self, state: State, reader: Reader) -> Iterator[tuple[str, Reader]]:
        head = self._last if self._is_speculated else state.head
        first, last = self._choice(reader, head)
        copied = (-1,) * len(self._setup.words)
        for serial in range(first, last + 1):
            begun = reader._replace(serial=serial, copied=copied, has_head=not self._is_speculated)
            yield f"read {serial}", begun
        if first > last:
            yield "find nothing new", self._ended(reader)

    def _choice(self, reader: Reader, head: int) -> tuple[int, int]:
        """Return the first and the last serial that a reader may take."""
        if self._is_speculated and not reader.serial:
            return reader.last + 1, head
        return max(reader.last, head - self._setup.depth) + 1, head

    def _ended(self, reader: Reader) -> Reader:
        return Reader(reader.last, reader.known, reader.reads - 1)

    def _is_good(self, reader: Reader) -> bool:
        """Check whether a copy is of the message sought, and whole."""
        copied = reader.copied
        serial = copied[self._serial]
        check = copied[self._check]
        is_whole = serial == copied[self._content] == check
        if self._setup.is_bound:
            # The checksum is combined with the epoch. Who forges a message may know the epoch.
            epochs = {copied[self._epoch] % EPOCHS, check % EPOCHS} - {0}
            is_whole = is_whole and len(epochs) < 2
        return serial // EPOCHS == reader.serial and (is_whole or not self._setup.is_checked)

    def _is_lawful(self, reader: Reader) -> bool:
        setup = self._setup
        epoch = reader.copied[self._epoch] % EPOCHS
        if not setup.is_claimed or epoch == reader.claim:
            return True
        if epoch == reader.known and reader.claim < 0 and not setup.is_claim_loaded:
            return True
        if not (epoch == reader.known or reader.known < epoch) or epoch >= reader.claim:
            return False
        return not setup.is_bounded or reader.serial <= reader.begun[epoch + 1]

    def _is_bad(self, reader: Reader) -> bool:
        """Check whether the reader has seen that it cannot take its copy."""
        if min(reader.copied) < 0:
            return False
        return not self._is_good(reader) or (reader.claim >= 0 and not self._is_lawful(reader))

    def _concluded(self, state: State, reader: Reader) -> Reader:
        """Return the reader after its verdict, if it has come to one. Raises `Violation`."""
        if not reader.has_head or min(reader.copied) < 0:
            return reader
        copied = reader.copied
        epoch = copied[self._epoch] % EPOCHS
        if self._is_good(reader):
            is_claim_needed = self._setup.is_claim_loaded or epoch != reader.known
            if reader.claim < 0 and is_claim_needed and self._setup.is_claimed:
                return reader
            if self._is_lawful(reader):
                self._check_returned(state, reader)
                return Reader(reader.serial, epoch, reader.reads - 1)
        if reader.head < 0:
            return reader
        if reader.serial >= reader.head + 2 - self._setup.depth:
            self._check_blame(state, reader)
        return self._ended(reader)

    def _check_returned(self, state: State, reader: Reader) -> None:
        message = reader.copied[self._content]
        published = [reader.serial * EPOCHS + epoch for epoch in state.epochs[reader.serial]]
        if self._setup.stops:
            published.append(reader.serial * EPOCHS + state.claim)
        if message not in published:
            raise Violation("a reader returns a message that was not published")
        is_single = self._setup.stops < 2 and not self._setup.kills
        if is_single and len(state.epochs[reader.serial]) > 1:
            raise Violation("two messages of one serial are published")
        if reader.serial <= reader.last:
            raise Violation("a reader returns messages out of order")

    def _check_blame(self, state: State, reader: Reader) -> None:
        setup = self._setup
        if not setup.losses and not setup.forgeries and not setup.stops:
            raise Violation("a reader takes a published message for a bad one")
