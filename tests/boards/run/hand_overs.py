"""Hand-overs in quick succession, each cut short at one store to shared memory.

    python -m tests.boards.run.hand_overs RACK 1000

In every round a new process takes over two mailboxes and publishes in both, while the process of
the round before may still live. It kills or stops itself before one of its stores: every store of
claim and publication has its turn. A stopped process continues while its successor takes over, or
after the successor has published. It then makes its remaining stores and, if it still believes that
it may write, publishes once more. This process reads after each round, another one all the time.

The result, as JSON, counts what must not happen. `double`: two processes that both believed to be
the writer in one epoch. `torn`: messages returned to a reader that nobody wrote like that. `stale`:
messages returned although their writer published them after its successor had. `missing`: messages
that were published undisturbed and not returned.
"""

from __future__ import annotations

import json
import mmap
import os
import signal
import sys
import time
from collections import Counter
from itertools import product
from random import Random
from typing import Any

import numpy as np

from rack.backplane.byte_lock import ByteLock
from rack.backplane.layout import TaskSpec
from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.mailbox import NO_MESSAGE_TICK
from rack.backplane.mailbox.protocols import open_reader, open_standby_writer
from rack.backplane.mailbox.slots import Slots, get_epoch, get_pid
from rack.backplane.segment import Segment, unlink_segment
from rack.backplane.watch.alarms import AlarmWriter
from rack.backplane.words import Box, HandOver, Run, System
from rack.boards.run.writing_right import WritingRight
from tests.backplane.bus import layout, mailbox, task
from tests.backplane.mailbox.mines import Bomb, Mined, mine
from tests.processes import fork, forked, wait_until

BOXES = ("writer.command", "writer.status")
COPIES = ("writer", "writer.standby", "writer.standby2")
NEVER = 1 << 40
PAUSE_S = 1e-4
"""Time between two reads of the reading process, which shares cores with the writers."""
LIMIT_S = 60
"""Time without a hand-over after which this process is killed by its alarm."""
ROUND = np.dtype(
    [
        ("pid", "i8"),
        ("tries", "i8"),  # to take over
        ("has_claimed", "i8"),
        ("epoch", "i8", len(BOXES)),  # in which it believed that it may write; 0: it did not
        ("has_published", "i8", len(BOXES)),
        ("is_void", "i8", len(BOXES)),  # replaced before it has published: nobody may read that
    ]
)
"""What the process of a round notes. That of round 0 is this process."""


COUNTS = np.dtype([(name, "i8") for name in ("read", "torn", "stale", "missing")])
LOOK = 20
"""Rounds with a crippled safeguard after which the counts are looked at."""
ENDS = tuple(product((signal.SIGKILL, signal.SIGSTOP), (True, False)))
"""How a process ends a round, and whether the one stopped before continues at once."""
CRIPPLES: dict[str, tuple[type, str, Any, str]] = {
    # Several processes may take over at once.
    "lock": (ByteLock, "take", lambda self: True, "double"),
    # Readers accept messages of any writer, and with any content.
    "claim": (Slots, "is_from_claimant", lambda self, known: True, "stale"),
    "checksum": (Slots, "passes_check", property(lambda self: True), "torn"),
}
"""A safeguard's class, its name and what cripples it; and what must not happen, and then does."""


def build_segment(rack: str) -> Segment:
    first, *others = COPIES
    tasks = [task(first), task("reader", slot=3)]
    tasks += [
        TaskSpec(name, first, "standby", 9 + number, 0, 0, 1, 1, 16, "signal")
        for number, name in enumerate(others)
    ]
    boxes = [mailbox(depth=4, name=name) for name in BOXES]
    segment = Segment.create(layout(rack, boxes, tasks), "")
    segment.words[System.STATE] = Run.RUNNING
    return segment


class Round:
    """The process of one round.

    Args:
        segment: Segment of the mailboxes.
        notes: What it notes, a row of `ROUND`.
        number: Number of the round, from 1.
        bomb: Ends or stops the process.
    """

    def __init__(self, segment: Segment, notes: Any, number: int, bomb: Bomb) -> None:
        self._notes = notes
        self._number = number
        notes["pid"] = os.getpid()
        writers = {name: open_standby_writer(segment, name) for name in BOXES}
        copy = COPIES[number % len(COPIES)]
        self.writers = tuple(writers.values())
        spec = segment.layout.find_task(copy)
        self._right = WritingRight(segment, spec, self.writers, AlarmWriter(segment, copy))
        for writer in self.writers:
            mine(writer, bomb)
        self._right.group = Mined(self._right.group, bomb)  # type: ignore[assignment]
        self._right._block = Mined(self._right._block, bomb)  # type: ignore[assignment]

    def take_over(self) -> None:
        """Take over and publish."""
        self._notes["tries"] += 1
        # A process that is stopped while it takes over keeps others from doing so. Another one may
        # have replaced this one at once.
        while not (
            self._right.take_over(self._number, HandOver.LOST) or self.writers[-1].claim.is_taken
        ):
            self._notes["tries"] += 1
            os.sched_yield()
        self._notes["has_claimed"] = 1
        self.publish(0)

    def publish(self, part: int) -> None:
        """Publish in all mailboxes, if this process believes that it may."""
        if not self._right.permits_writing:
            return
        for box, writer in enumerate(self.writers):
            self._notes["epoch"][box] = get_epoch(writer.slots.signature)
            writer.message.row[:] = 2 * self._number + part
            writer.write(self._number)
            self._notes["has_published"][box] = 1


class ReadChecks:
    """Checks of all messages that one reader gets from one mailbox.

    Args:
        segment: Segment of the mailboxes.
        box: Number of the mailbox.
        rounds: Notes of all rounds.
        counts: Counts what must not happen, and all messages.
    """

    def __init__(self, segment: Segment, box: int, rounds: Any, counts: Any) -> None:
        self._reader = open_reader(segment, BOXES[box])
        self._box, self._rounds, self._counts = box, rounds, counts
        self._last = (0, 0)
        self.newest = 0
        """Number of the round whose message was read last."""

    def read(self) -> None:
        """Read the newest message, and count what must not be."""
        reading = self._reader.read(NO_MESSAGE_TICK)
        if reading.is_new:
            signature = int(self._reader.words[6])
            row = [int(value) for value in reading.message.row]
            self.newest = self.check_message(row, signature, self._reader.serial)

    def check_message(self, row: list[int], signature: int, serial: int) -> int:
        """Check a message. Return the number of its round, 0 for none."""
        counts = self._counts
        counts["read"] += 1
        number = row[0] // 2
        is_known = len(set(row)) == 1 and 0 <= number < len(self._rounds)
        if not is_known or self._rounds["pid"][number] != get_pid(signature):
            counts["torn"] += 1
            return 0
        is_older = get_epoch(signature) < self._last[0] or serial <= self._last[1]
        if is_older or self._rounds["is_void"][number, self._box]:
            counts["stale"] += 1
        self._last = get_epoch(signature), serial
        return number


def read_on(segment: Segment, rounds: Any, counts: Any) -> None:
    """Read both mailboxes for as long as this process lives."""
    checks = [ReadChecks(segment, box, rounds, counts) for box in range(len(BOXES))]
    while True:
        for check in checks:
            check.read()
        time.sleep(PAUSE_S)


def has_changed(pid: int) -> bool:
    """Check whether a child has ended or stopped. It remains to be waited for."""
    options = os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT
    return os.waitid(os.P_PID, pid, options) is not None


def share(dtype: np.dtype, count: int) -> Any:
    """Return an array that forked processes share."""
    return np.frombuffer(mmap.mmap(-1, dtype.itemsize * count), dtype, count)


class HandOvers:
    """Rounds of hand-overs in one segment.

    Args:
        segment: The segment.
        count: Number of rounds.
    """

    def __init__(self, segment: Segment, count: int) -> None:
        self._segment = segment
        self.rounds = share(ROUND, count + 1)
        self.counts = share(COUNTS, 2)
        self._boxes = [segment.get_box(name) for name in BOXES]
        self._checks = [
            ReadChecks(segment, box, self.rounds, self.counts[1]) for box in range(len(BOXES))
        ]
        self._rings = [MailboxRing(segment, name) for name in BOXES]
        self._history = [
            ReadChecks(segment, box, self.rounds, self.counts[1]) for box in range(len(BOXES))
        ]
        self.ends: Counter[str] = Counter()
        self.stores = self._count_stores()

    def _count_stores(self) -> int:
        """Return the number of stores of a whole hand-over."""
        bomb = Bomb(NEVER)
        process = Round(self._segment, self.rounds[0], 0, bomb)
        process.take_over()
        self.rounds["epoch"][0] = 0
        for writer in process.writers:
            writer.close()
        return NEVER - bomb.left

    def run(self, wrong: str = "") -> None:
        """Run all rounds, or until something `wrong` has happened, while a process reads."""
        with forked(lambda: read_on(self._segment, self.rounds, self.counts[0])):
            before = 0
            for number in range(1, len(self.rounds)):
                signal.alarm(LIMIT_S)
                before = self._run_round(number, before)
                if wrong and number % LOOK == 0 and self.to_document()[wrong]:
                    break
            signal.alarm(0)
            self._end_stopped(before)

    def _choose_store(self, number: int) -> int:
        """Return the store before which a round ends. In random order, each has its turn."""
        lap, place = divmod(number, self.stores + 1)
        return Random(lap).sample(range(self.stores + 1), self.stores + 1)[place]

    def _run_round(self, number: int, before: int) -> int:
        """Run one round.

        Args:
            number: Number of the round.
            before: Number of the round whose process is stopped. 0 for none.

        Returns:
            This number if the process is stopped, otherwise 0.
        """
        rounds = self.rounds
        store = self._choose_store(number)
        kind, is_soon = Random(number).choice(ENDS)
        # A process that is stopped in its claim must end before another one can take over.
        is_soon = is_soon or (before > 0 and not rounds["has_claimed"][before])

        def work() -> None:
            bomb = Bomb(store, kind)
            process = Round(self._segment, rounds[number], number, bomb)
            process.take_over()
            if bomb.left >= 0:
                # It made too few stores, and must not be stopped twice.
                bomb.left = -1
                os.kill(os.getpid(), kind)
            process.publish(1)

        pid = fork(work)
        if before and is_soon:
            if not rounds["has_claimed"][before]:
                wait_until(lambda: rounds["tries"][number] > 1 or has_changed(pid))
            os.kill(int(rounds["pid"][before]), signal.SIGCONT)
        _, status = os.waitpid(pid, os.WUNTRACED)
        is_stopped = os.WIFSTOPPED(status)
        self.ends["stopped" if is_stopped else "killed"] += 1
        assert is_stopped or os.WTERMSIG(status) == signal.SIGKILL, status
        if before and is_soon:
            self._reap(before)
            self.ends["continued at once"] += 1
        elif rounds["has_published"][number].all():
            self._read_now()
            self.counts[1]["missing"] += sum(c.newest != number for c in self._checks)
        if before and not is_soon:
            for box, words in enumerate(self._boxes):
                is_replaced = get_pid(words[Box.CLAIMANT]) != rounds["pid"][before]
                rounds["is_void"][before, box] = (
                    is_replaced and not rounds["has_published"][before, box]
                )
            self.ends["continued too late"] += bool(rounds["is_void"][before].any())
            self._end_stopped(before)
        self._read_now()
        return number if is_stopped else 0

    def _end_stopped(self, number: int) -> None:
        """Let the stopped process of a round continue and end."""
        if number:
            os.kill(int(self.rounds["pid"][number]), signal.SIGCONT)
            self._reap(number)

    def _reap(self, number: int) -> None:
        status = os.waitpid(int(self.rounds["pid"][number]), 0)[1]
        assert status == 0, status

    def _read_now(self) -> None:
        """Read everything as a board does, as a board that has just started, and as a recorder."""
        for box, check in enumerate(self._checks):
            check.read()
            ReadChecks(self._segment, box, self.rounds, self.counts[1]).read()
            # A stopped process may have set the head to what its successor has filled.
            self.rounds["has_published"][check.newest, box] = 1
        for ring, check in zip(self._rings, self._history, strict=True):
            for row in ring.read_new_rows().rows:
                content = [int(value) for value in row["message"]["row"]]
                check.check_message(content, int(row["epoch"]), int(row["serial"]))

    def to_document(self) -> dict[str, Any]:
        """Return all counts."""
        epochs = self.rounds["epoch"]
        double = sum(
            len(own) - len(set(own))
            for own in ([int(epoch) for epoch in column if epoch] for column in epochs.T)
        )
        counts = {name: int(self.counts[name].sum()) for name in COUNTS.names or ()}
        return {
            "hand_overs": int(self.rounds["has_claimed"].sum()),
            "rounds": len(self.rounds) - 1,
            "stores": self.stores,
            **self.ends,
            **counts,
            "double": double,
        }


def main(rack: str, count: int, cripple: str = "") -> None:
    wrong = ""
    if cripple:
        owner, name, crippled, wrong = CRIPPLES[cripple]
        setattr(owner, name, crippled)
    segment = build_segment(rack)
    try:
        hand_overs = HandOvers(segment, count)
        hand_overs.run(wrong)
        sys.stdout.write(json.dumps(hand_overs.to_document()))
    finally:
        unlink_segment(rack)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
