"""A small rack without an arm, as TOML text and as files."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import count
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

from rack.tools.commands.new import TEMPLATES
from tests import warm
from tests.link import MakeLink, links
from tests.machine import stolen, turn

SMALL = f"""
format = 2
name = "small"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 2.5
mode = "lockstep"

# In real time a test machine may be busy.
[supervision]
max_missed_fraction = 1.0

[board.upper]
slot = 2
rate_hz = 50
below = "lower"
executor = "two_levels:Upper"
ends_run = true

[board.lower]
slot = 3
rate_hz = 400
above = "upper"
executor = "two_levels:Lower"
planner = "two_levels:LowerPlanner"
coupling = "tight"
within_cycles = 4
"""


EXHAUSTIVE = "EXHAUSTIVE" in os.environ
"""Whether tests try all values of which they try a sample otherwise: `make thorough EXHAUSTIVE=1`,
by hand, takes hours."""
_NUMBERS = count()
APART = frozenset(
    f"tests/{name}.py"
    for name in (
        "backplane/mailbox/test_model",
        "boards/config/rules/test_changed_values",
        "boards/crate/test_random_ticks",
        "boards/faults/test_every_fault",
        "test_course",
        "test_examples",
        "test_golden",
        "test_guides",
        "test_ibm",
        "test_rccl",
        "tools/commands/test_campaign",
        "tools/lab/reproduction/test_rulings",
    )
)
"""Files of long tests that share nothing."""

# A busy machine may hold up any example.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")
_NO_TURN = pytest.StashKey[str]()
_STOLEN = pytest.StashKey[int]()
RERUNS = 2


def pytest_configure() -> None:
    """Give commands that tests start their signals back: under nohup, or in a script's background,
    some are ignored."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) == signal.SIG_IGN:
            # Handled, and not the default: the session itself outlives them still. Programs do not
            # inherit a handler.
            signal.signal(number, lambda number, frame: None)


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """Keep all modules and items out of collections of garbage: looking through them takes a third
    of a second, every time."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()
    # At the end they are freed as ever: libraries complain about what is left.
    atexit.register(gc.unfreeze)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run what judges real-time processes again if it has failed while the hypervisor held cores
    back: that judges the machine. Without steal a failure is one at once.

    Long tests come first, and those that need the machine to themselves last, so that workers
    seldom wait for each other.
    """
    for item in items:
        if item.get_closest_marker("alone"):
            again = pytest.mark.flaky(reruns=RERUNS, condition=partial(_is_disturbed, item))
            item.add_marker(again)
            item.add_marker(pytest.mark.xdist_group("alone"))
    items.sort(key=_rank)


def _rank(item: pytest.Item) -> tuple[bool, bool, bool]:
    """Return the key by which tests are ordered. The files at the top run whole racks."""
    file = item.nodeid.partition("::")[0]
    return item.get_closest_marker("alone") is not None, file not in APART, file.count("/") > 1


class Distribution(LoadFileScheduling):
    """Hands out tests file by file, because the tests of a file share recorded runs; those of
    `APART` one by one; and those marked `alone` together."""

    def _split_scope(self, nodeid: str) -> str:
        """Return the name of the unit of work that a test belongs to."""
        if nodeid.endswith("@alone"):
            return "alone"
        file = super()._split_scope(nodeid)
        return nodeid if file in APART else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> Distribution:
    """Hand out tests by `Distribution`."""
    return Distribution(config, log)


def _is_disturbed(item: pytest.Item) -> bool:
    return stolen() > item.stash[_STOLEN]


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Take turns with tests that need the machine to themselves.

    Out here, and not in a fixture: the time-out of a test begins within, so it does not count the
    wait.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(turn(alone=item.get_closest_marker("alone") is not None))
        except TimeoutError as error:
            item.stash[_NO_TURN] = str(error)
        item.stash[_STOLEN] = stolen()
        yield


@pytest.fixture(autouse=True)
def _turn(request: pytest.FixtureRequest) -> None:
    """Fail a test that has waited in vain: an error of the hook would end the whole session."""
    if _NO_TURN in request.node.stash:
        pytest.fail(request.node.stash[_NO_TURN])


@pytest.fixture(scope="session", autouse=True)
def _in_stock() -> Iterator[None]:
    """Start the crates and recorders of racks in this process from stock."""
    warm.fill()
    with pytest.MonkeyPatch.context() as patch:
        for starter in warm.STARTERS:
            patch.setattr(starter, "subprocess", warm.subprocess_in_stock)
        yield
    warm.clear()


@pytest.fixture
def rack_name() -> str:
    """A name for a rack that no other test, of this run or another, uses at the same time."""
    return f"test-{os.getpid()}-{next(_NUMBERS)}"


@pytest.fixture
def link(rack_name: str) -> Iterator[MakeLink]:
    """Make links of a writer and a reader over one mailbox."""
    with links(rack_name) as make:
        yield make


@pytest.fixture
def small(write: Callable[[str, str], Path]) -> Path:
    """A rack of two levels that count, as a file."""
    return write("small.toml", SMALL)


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str, str], Path]:
    """Write a file beside the small rack's."""

    def write_file(name: str, text: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    return write_file


@pytest.fixture
def without_templates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the templates of `rack new`, which other tests may have made importable."""
    folders = [folder for folder in sys.path if not Path(folder).is_relative_to(TEMPLATES)]
    monkeypatch.setattr(sys, "path", folders)
    for kind in ("level", "servo", "planner"):
        monkeypatch.delitem(sys.modules, f"my_{kind}", raising=False)
