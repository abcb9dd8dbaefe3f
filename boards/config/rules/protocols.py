"""Checks on the exchange of boards, and on what `protocol.strict` refuses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from rack.backplane.layout import BY_TICKS, ExchangeSpec
from rack.boards.config.schema import RackConfig
from rack.boards.errors import Mistake
from rack.levels.level import Input

if TYPE_CHECKING:
    from rack.boards.config.layout import Wiring


def exchanges(config: RackConfig, board: str) -> dict[str, ExchangeSpec]:
    """Return how a board's executor reads the ports listed in its table, by port; times in ticks."""
    every, phase = config.every(board), config.board[board].phase
    return {
        port: ExchangeSpec(board, every * entry.every, phase + every * entry.phase, entry.asynchronous)
        for port, entry in config.board[board].exchange.items()
    }


def exchange_mistakes(config: RackConfig, board: str, inputs: Mapping[str, Input]) -> Iterator[Mistake]:
    """Yield the mistakes in the exchange of a board whose executor has these inputs."""
    for port, entry in config.board[board].exchange.items():
        place = f"board.{board}.exchange.{port}"
        if port not in inputs:
            yield Mistake(place, None, f"no such port of the executor; ports: {', '.join(inputs) or 'none'}")
        if entry.asynchronous and entry.every > 1:
            yield Mistake(f"{place}.every", entry.every, "an asynchronous port is read in every cycle; permitted: 1")
        elif entry.phase >= entry.every:
            why = f"must be less than every; permitted: 0 to {entry.every - 1} cycles"
            yield Mistake(f"{place}.phase", entry.phase, why)


def asynchronous_mistakes(wiring: Wiring) -> Iterator[Mistake]:
    """Yield a mistake for every mailbox that an asynchronous port reads, and cannot read at once."""
    for ports in wiring.tasks:
        entries = wiring.config.board[ports.place.board].exchange if ports.place.role == "executor" else {}
        for port, mailbox in ports.sources:
            why = {
                "queue": f"'{mailbox}' is a queue, and its messages are taken by ticks; permitted: false",
                "interrupt": f"the messages of '{mailbox}' interrupt the board as they come already; permitted: false",
            }.get(wiring.protocol(mailbox))
            if port in entries and entries[port].asynchronous and why is not None:
                yield Mistake(f"board.{ports.place.board}.exchange.{port}.asynchronous", True, why)


def strict_mistakes(config: RackConfig) -> Iterator[Mistake]:
    """Yield a mistake for everything that makes a run depend on timing, if that is refused."""
    if not config.protocol.strict:
        return
    why = "makes a run depend on timing, refused by protocol.strict = true; permitted"
    if config.protocol.default not in BY_TICKS:
        yield Mistake("protocol.default", config.protocol.default, f"{why}: time-slice, interrupt")
    for mailbox, protocol in config.protocol.mailbox.items():
        if protocol not in BY_TICKS:
            yield Mistake(f"protocol.mailbox.{mailbox}", protocol, f"{why}: {', '.join(BY_TICKS)}")
    for name in config.host:
        yield Mistake(f"host.{name}", None, f"a board without real time {why}: boards with a rate")
    for name, board in config.board.items():
        for port, entry in board.exchange.items():
            if entry.asynchronous:
                yield Mistake(f"board.{name}.exchange.{port}.asynchronous", True, f"{why}: false")
