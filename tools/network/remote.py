"""A rack on another machine, as if it were here: its mirrored segment, and commands to it."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from io import BytesIO
from typing import Self

from rack.backplane.address_map import OPERATOR_ENTRIES
from rack.backplane.operator_table import (
    Client,
    Request,
    RequestEntry,
    RequestStage,
    RequestWord,
)
from rack.boards.lan.questions import (
    MOST_CONTENT,
    MOST_STRETCHES,
    DeskAnswer,
    Stretch,
    Ticket,
    What,
    packed_request,
    packed_stretches,
)
from rack.tools.console.address import Asker, RackAddress
from rack.tools.console.answer import Failure
from rack.tools.network.mirror import Mirror
from rack.tools.network.questioner import FarLaunch, Questioner, not_permitted

LOOK_S = 0.2
"""Time between two looks at whether a rack is still there."""
AT_ONCE = 4
"""Questions on their way at once: as many as a desk answers in one cycle."""


class RemoteRack:
    """One launch of a rack on another machine, in a context.

    `segment` is a mirror of its segment as of the last `refresh`. Raises `Failure` when the rack
    cannot be reached, or does not permit this user to watch.
    """

    def __init__(self, address: RackAddress, asker: Asker) -> None:
        self.address = address
        self._asker = asker
        self._racks = Questioner(address.at, asker)
        try:
            self._launch = self._racks.launch(address.rack)
            self.segment = Mirror(str(address), self._fetch)
            self.segment.refresh()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """End the session."""
        self._racks.__exit__()

    def refresh(self) -> bool:
        """Fetch what has changed; False when the rack is gone, or does not answer any more."""
        segment = self.segment
        if segment.is_there:
            try:
                segment.refresh()
            except Failure:
                segment.is_there = False
        return segment.is_there

    def follow(self, mailbox: str) -> None:
        """Fetch every message of a mailbox from now on, as far as its slots reach back."""
        self.segment.follow(mailbox)

    def _fetch(self, stretches: Sequence[Stretch]) -> tuple[list[bytes], DeskAnswer]:
        found: list[bytes] = []
        questions = list(_questions(stretches))
        for at in range(0, len(questions), AT_ONCE):
            group = questions[at : at + AT_ONCE]
            payloads = [packed_stretches(part) for part in group]
            answers = self._racks.ask(self._launch, "read", payloads)
            for part, answer in zip(group, answers, strict=True):
                found += _parts(answer.content, part)
        return found, answer

    @contextmanager
    def claim(self, request: Request, client: Client) -> Iterator[RequestEntry]:
        """Give a request to the rack. At the end of the `with` block end its lease, or withdraw it
        unless it has been issued."""
        permit = tomllib.loads(self.segment.config)["adapter"]["lan"].get("permit", {})
        if "command" not in permit.get(self._asker.name, ()):
            raise Failure(f"rack '{self.address.rack}' {not_permitted(self._asker, 'command')}")
        what: What = "lease" if client is Client.LEASES else "give"
        (answer,) = self._racks.ask(self._launch, what, [packed_request(request)])
        ticket = Ticket.unpacked(answer.content)
        if ticket is None or ticket.entry >= OPERATOR_ENTRIES:
            raise Failure(f"rack '{self.address}': its answer to the command is malformed")
        entry = RequestEntry(self.segment, ticket.entry)
        try:
            self.refresh()
            yield entry
        finally:
            is_known = entry[RequestWord.TICKET] == ticket.number
            is_given = is_known and entry.stage != RequestStage.WAITING
            if client is Client.LEASES or not is_given:
                # If the rack is out of reach, it does so by itself.
                with suppress(Failure):
                    list(self._racks.ask(self._launch, "withdraw", [ticket.packed()]))


def stop(address: RackAddress, asker: Asker) -> int:
    """Set the emergency stop of a rack; return the tick at which that was done. Raises
    `Failure`."""
    with Questioner(address.at, asker) as racks:
        return _stop(racks, address.rack)


def stop_when(
    pressed: Callable[[float], bool],
    address: RackAddress,
    asker: Asker,
    tell: Callable[[str], None],
) -> int:
    """Stay connected to a rack, and set its emergency stop once `pressed` says so, which waits for
    that up to a time in s; return the tick at which it was set.

    `tell` gets, again and again, whether it could be set. What is pressed while it cannot is tried
    until it can. Raises `Failure` if it cannot from the beginning.
    """
    with Questioner(address.at, asker) as racks:
        checked: FarLaunch | None = None
        while checked is None or not pressed(LOOK_S):
            try:
                if (launch := racks.launch(address.rack)) != checked:
                    racks.check_stop(launch)
                    checked = launch
                tell(f"ready to stop rack '{address}'")
            except Failure as failure:
                if checked is None:
                    raise
                tell(f"not ready: {failure}")
        while True:
            try:
                return _stop(racks, address.rack)
            except Failure as failure:
                tell(f"not stopped yet: {failure}")


def _stop(racks: Questioner, rack: str) -> int:
    (answer,) = racks.ask(racks.launch(rack), "stop", [b""])
    return answer.tick


def _questions(stretches: Sequence[Stretch]) -> Iterator[list[Stretch]]:
    """Yield stretches in groups that one answer holds."""
    group: list[Stretch] = []
    size = 0
    for stretch in stretches:
        if group and (size + stretch.size > MOST_CONTENT or len(group) == MOST_STRETCHES):
            yield group
            group = []
            size = 0
        group.append(stretch)
        size += stretch.size
    if group:
        yield group


def _parts(content: bytes, stretches: Sequence[Stretch]) -> Iterator[bytes]:
    """Yield the part of an answer that belongs to each stretch. Raises `Failure` when it is too
    short or too long."""
    if len(content) != sum(stretch.size for stretch in stretches):
        raise Failure("an answer is not as long as what was asked for")
    parts = BytesIO(content)
    for stretch in stretches:
        yield parts.read(stretch.size)
