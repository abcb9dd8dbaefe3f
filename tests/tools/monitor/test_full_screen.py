"""Tests the full screen of `rack top` on a rack in lockstep: its views and its keys."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable, Iterator
from contextlib import closing
from html import unescape

import pytest
from textual.pilot import Pilot
from textual.widgets import Input

from rack.backplane.segment import Segment, list_racks
from rack.tools.monitor.full_screen import RackScreen
from tests.processes import wait_until
from tests.tools.command_line import BOUND_S, rack
from tests.tools.monitor.test_desk import homing_rack

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The name of a rack that runs until the last test stops it."""
    path = tmp_path_factory.mktemp("rack") / "commanded.toml"
    with homing_rack(path, f"test-screen-{os.getpid()}") as name:
        yield name


def on_screen(
    name: str, act: Callable[[Pilot[None]], Awaitable[None]], size: tuple[int, int] = (80, 24)
) -> None:
    """Run a function with the screen of a rack."""

    async def attached() -> None:
        with closing(Segment.attach(name)) as one:
            async with RackScreen(one, lambda: False).run_test(size=size) as pilot:
                await act(pilot)
                # As a user leaves: what is taken down without it may be looked at once more.
                pilot.app.exit()

    asyncio.run(asyncio.wait_for(attached(), 3 * BOUND_S))


def seen(pilot: Pilot[None]) -> str:
    """Return the text of the screen."""
    return unescape(pilot.app.export_screenshot()).replace("\N{NO-BREAK SPACE}", " ")


async def shows(pilot: Pilot[None], *words: str, not_any_more: str = "") -> None:
    """Wait until the screen shows all of these, and does not show a text any more."""
    async with asyncio.timeout(BOUND_S):
        while not all(word in seen(pilot) for word in words) or (
            not_any_more and not_any_more in seen(pilot)
        ):
            await pilot.pause(0.05)


async def write(pilot: Pilot[None], text: str) -> None:
    """Write a command, and send it."""
    await pilot.press("c")
    pilot.app.query_one(Input).value = text
    await pilot.press("enter")


@pytest.mark.thorough
def test_the_panes_show_boards_mailboxes_events_and_lateness(running: str) -> None:
    async def act(pilot: Pilot[None]) -> None:
        await shows(pilot, running, "upper", "lower", "missed", "late ms", "executing")
        await pilot.press("2")
        await shows(pilot, "upper.command", "period_ms", "2.5", "20.0", "written")
        await pilot.press("4")
        await shows(pilot, "late us", "upper", "< inf")
        await pilot.press("l")
        await shows(pilot, "lower")
        await write(pilot, "lower modify twice on")
        await pilot.press("3")
        await shows(pilot, "command: lower: modify twice on")
        # At this width the boards have sparklines, and events below them.
        await pilot.resize_terminal(160, 40)
        await pilot.press("1")
        await shows(pilot, "lateness", "▁", "events, newest first:", "lower: modify twice on")
        lines = [line for line in seen(pilot).splitlines() if "<text" in line]
        places = [
            next(at for at, line in enumerate(lines) if word in line)
            for word in ("restarts", "events, newest", "modify twice on")
        ]
        assert places == sorted(places)

    on_screen(running, act)


def test_keys_command_the_chosen_level_until_the_run_ends(running: str) -> None:
    async def act(pilot: Pilot[None]) -> None:
        await pilot.press("h")
        await shows(pilot, "held by the operator", f"rack command {running} upper resume")
        await pilot.press("r")
        await shows(pilot, not_any_more="held by the operator")
        await pilot.press("l", "h")
        await shows(pilot, "held by the operator", f"rack command {running} lower resume")
        await pilot.press("r")
        await shows(pilot, not_any_more="held by the operator")
        # The menu of faults is about the chosen level, the upper one again.
        await pilot.press("l")
        await pilot.press("i")
        await shows(pilot, "kill")
        await pilot.press("enter")
        assert pilot.app.query_one(Input).value == "inject upper kill"
        pilot.app.query_one(Input).value = "inject upper mute for=100s"
        await pilot.press("enter")
        await shows(pilot, "fault: mute of upper")
        await pilot.press("3")
        await shows(pilot, "fault: upper: mute begins, for 40000 ticks")

        # The screen ends with the run.
        assert rack("stop", running).returncode == 0
        async with asyncio.timeout(BOUND_S):
            while pilot.app.is_running:
                await pilot.pause(0.05)

    on_screen(running, act, (100, 30))
    wait_until(lambda: running not in list_racks(), BOUND_S)
