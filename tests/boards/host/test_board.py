"""Boards of the host side as real processes: whatever they do, the real-time side goes on as
without them."""

from __future__ import annotations

import inspect
import os
import signal

import pytest

from rack.backplane.errors import MailboxError
from rack.backplane.mailbox.history import find_chains
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.boards import Rack
from rack.boards.config import resolve
from rack.boards.config.schema import RackConfig
from rack.boards.host.bus import HostBus
from rack.levels.errors import LevelError
from tests.boards.conftest import CLOCK, MakeConfig, format_board
from tests.boards.host_programs import Failing, Host
from tests.boards.runs import end_of, stop, watch_until
from tests.processes import runs, wait_until

BUS_ADAPTER = "rack.boards.host.bus_adapter:BusAdapter"
HOSTED = f"""{CLOCK}
{format_board("bridge", 2, BUS_ADAPTER, rate_hz=100, below="adder", ends_run=True)}
[board.bridge.params.pass]
numbers = {{ from = "program.numbers", asynchronous = true }}
sum = {{ from = "adder.status" }}

{format_board("adder", 3, "host_programs:Adder", rate_hz=400, above="bridge")}
[host.program]
program = "host_programs:Counting"
below = "bridge"
"""
"""A program sends numbers through a bridge to a level that adds them."""


def hosted(config: MakeConfig, program: str, *settings: str) -> RackConfig:
    """Return the rack with another program."""
    return config(f"host.program.program=host_programs:{program}", *settings, text=HOSTED)


ENDS = ("died", "restart", "rejoined", "given_up", "done")
"""Codes of events about the process of a host board."""


def status(segment: Segment, board: str = "bridge") -> object:
    return open_observer(segment, f"{board}.status").peek().message


def codes(rack: Rack, board: str) -> list[str]:
    """Return the codes of the events of a board."""
    return [event.code for event in rack.events if event.board == board]


@pytest.mark.slow
def test_a_program_sends_every_number_once_and_its_return_ends_the_run(config: MakeConfig) -> None:
    depth = "protocol.depth={ 'program.numbers' = 8 }"
    with Rack(hosted(config, "Counting", "host.program.params.count=50", depth)) as rack:
        outcome = rack.run()
        assert (outcome.cause, status(rack.segment, "adder").sum) == ("task done", 50 * 51 / 2)
        entry = status(rack.segment).numbers
        assert (entry["passed"], entry["refused"], entry["superseded"]) == (50, 0, 0)
        assert 0 <= entry["arrived"] < outcome.ticks
    assert "died" not in codes(rack, "program")


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_program_that_the_end_of_the_run_interrupts_has_not_failed(
    config: MakeConfig, mode: str
) -> None:
    with Rack(hosted(config, "Persistent", f"clock.mode={mode}")) as rack:
        rack.run(0.5)
        block = rack.segment.get_block("program")
        wait_until(lambda: block[Block.STATE] == TaskState.ENDED)
    assert not {"died", "restart"} & {*codes(rack, "program")}


@pytest.mark.slow
def test_hung_dead_failed_and_finished_programs_do_not_affect_the_real_time_side(
    config: MakeConfig,
) -> None:
    others = {"hung": "Waiting", "failed": "Failing", "finished": "Ending", "killed": "Waiting"}
    # No level reads what they send.
    entries = [f'{name} = {{ from = "{name}.numbers" }}\n' for name in others]
    tables = [
        f'[host.{name}]\nprogram = "host_programs:{program}"\nbelow = "bridge"\n'
        for name, program in others.items()
    ]
    text = HOSTED.replace("sum = {", "".join(entries) + "sum = {") + "".join(tables)
    settings = ("board.bridge.ends_run=false", "host.program.program=host_programs:Console")
    settings += ("host.failed={ restarts = 1, restarts_within_s = 1e6 }",)
    with Rack(config(*settings, text=text)) as rack:
        rack.start()
        block = rack.segment.get_block("killed")
        wait_until(lambda: block[Block.PID] > 0 and rack.watch(0.01) is not None)
        os.kill(block[Block.PID], signal.SIGKILL)
        ends = {"killed": "rejoined", "failed": "given_up", "finished": "done"}
        watch_until(rack, lambda: all(code in codes(rack, board) for board, code in ends.items()))
        stop(rack)
        assert rack.segment.words[System.EMERGENCY_STOP] == 0
        assert (
            sum(
                rack.segment.get_block(task.name)[Block.MISSED]
                for task in rack.segment.layout.tasks
            )
            == 0
        )
        assert rack.outcome is not None
        ticks = rack.outcome.ticks
        found = find_chains(rack.segment, ticks)["adder.status"]
    assert codes(rack, "killed") == ["died", "restart", "rejoined"]
    # It may fail again before the Rack has seen its new process.
    failed = [code for code in codes(rack, "failed") if code != "rejoined"]
    assert failed == ["died", "restart", "died", "given_up"]
    line = inspect.getsourcelines(Failing.run)[1] + 1
    printed = [event.text for event in rack.events if event.kind == "printed"]
    assert (
        printed
        == [f"host board 'failed': ValueError: no numbers (host_programs.py, line {line})"] * 2
    )
    external = [f"host.{name}.external=true" for name in ("program", *others)]
    with Rack(config(*settings, *external, text=text)) as alone:
        alone.run(ticks * 0.0025)
        assert find_chains(alone.segment, ticks)["adder.status"] == found


@pytest.mark.slow
def test_a_program_that_blocks_every_signal_ends_with_its_rack_and_its_children(
    config: MakeConfig,
) -> None:
    # The fixture checks that no process is left.
    with Rack(hosted(config, "Deaf", "clock.mode=realtime")) as rack:
        rack.start()
        watch_until(rack, lambda: status(rack.segment, "adder").sum > 0)
        stop(rack)


def daemons(rack: Rack) -> list[int]:
    """Return the processes that the program has left behind, by what they printed."""
    return [int(event.text.split()[1]) for event in rack.events if event.text.startswith("daemon ")]


@pytest.mark.slow
def test_a_daemon_in_another_session_ends_with_its_host_board(
    config: MakeConfig,
) -> None:
    with Rack(hosted(config, "Escaping", "clock.mode=realtime")) as rack:
        rack.start()
        wait_until(lambda: rack.watch(0.01) and bool(daemons(rack)))
        first = daemons(rack)[0]
        os.kill(rack.segment.get_block("program")[Block.PID], signal.SIGKILL)
        wait_until(lambda: rack.watch(0.01) and "died" in codes(rack, "program"))
        assert not runs(first)
        # Another one ends with the rack.
        wait_until(lambda: rack.watch(0.01) and len(daemons(rack)) == 2)
    assert not runs(daemons(rack)[1])


@pytest.mark.slow
def test_a_board_has_one_process_and_an_external_one_may_change(config: MakeConfig) -> None:
    found = hosted(config, "Console", "host.program.external=true")
    with Rack(found) as rack:
        rack.start()
        (wiring,) = resolve(found).hosts
        program = Host(wiring.context)
        first = HostBus(rack.segment, wiring)
        with pytest.raises(
            MailboxError, match=rf"'program' is already running \(process {os.getpid()}\)"
        ):
            HostBus(rack.segment, wiring)
        with pytest.raises(LevelError, match="port 'numbers': no board has connected it"):
            program.send_number(2.0)
        first.connect_ports(program)
        assert program.send_number(2.0)
        first.close()
        second = HostBus(rack.segment, wiring)
        second.connect_ports(program)
        assert program.send_number(3.0)
        wait_until(lambda: rack.watch(0.01) and program.sum.read().message.last == 2)
        assert (program.sum.read().message.sum, program.numbers.sent) == (5.0, 2)
        with pytest.raises(AttributeError, match="no field 'valu'; did you mean 'value'"):
            program.numbers.message.valu = 1  # type: ignore[attr-defined]
        second.finish()
        assert end_of(rack).cause == "task done"
        assert second.is_over
        assert not second.wait(60.0)
        second.close()
