"""`rack rewind`: go to any tick of a recorded run, and branch off from it."""

from __future__ import annotations

import argparse
import cmd
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from inspect import cleandoc
from pathlib import Path
from typing import Any, NoReturn

from rack.backplane.json_text import encode_json
from rack.boards.errors import to_one_line
from rack.levels.tables import LAST_TICK
from rack.tools.console.answer import MAX_LINE, Failure, convert_errors, print_text
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Anyway, Json, RunFolder
from rack.tools.monitor.display import open_display
from rack.tools.scripting.rewound import RewindAnswer, RewoundRun

USAGE = {
    "goto": 'goto TIME, as in 12.5; or goto --when "servo.status.position[2] > 1.2"',
    "step": "step [TICKS]",
    "back": 'back [TICKS]; or back --when "servo.status.position[2] > 1.2"',
    "show": "show NAME, of a mailbox, a signal or a level",
    "events": "events [SECONDS]",
    "branch": "branch [--set KEY=VALUE]... [--faults FILE] [--seconds S] [--out DIR]",
    "help": "help [COMMAND]",
    "quit": "quit",
}
MAX_SECONDS = 1e9


def rewind(run: RunFolder, anyway: Anyway = False, as_json: Json = False) -> None:
    """Go to any tick of a recorded run, inspect messages and levels, and branch off.

    The command opens a prompt. Commands can also come from stdin, one per line. With --json each
    answer is a document on one line, and the answer of a failed command has the key 'error'.

    \b
      goto 12.5, goto --when "servo.status.position[2] > 1.2"
      step [TICKS], back [TICKS], back --when CONDITION
      show primitive.status, show primitive.plan, show servo.status.position[2]
      show primitive          the attributes of the level's object
      events [SECONDS]        what happened around this tick
      branch [--set KEY=VALUE]... [--faults FILE] [--seconds S] [--out DIR]
      help [COMMAND], quit

    Each tick is shown in the state before its tasks begin, with the messages that they are about to
    read. Messages and events come from the recording. For the objects of levels, and for branches,
    the rack runs again unchanged, from the beginning or from an earlier snapshot. RUN itself is not
    changed.

    Exit status: 0 the prompt was left, and all commands from stdin or with --json worked; 2 one of
    them failed, or RUN is not a run.

    \b
    Examples:
      rack rewind runs/whole
      printf 'goto 12.5\\nshow servo.status\\n' | rack rewind runs/whole --json
    """
    with INTERRUPT.raise_interrupted(), RewoundRun(run, anyway) as rewound:
        prompt = RewindPrompt(rewound, as_json)
        if sys.stdin.isatty() and not as_json:
            with suppress(ImportError):
                import readline  # noqa: F401  line editing and history
            prompt.cmdloop(f"{run}; 'help' lists the commands")
            return
        for line in sys.stdin:
            if prompt.onecmd(line):
                break
    if prompt.failed_count:
        sys.exit(2)


class _ArgumentParser(argparse.ArgumentParser):
    """Parser for the arguments of a command at the prompt. A mistake raises `Failure`."""

    def error(self, message: str) -> NoReturn:
        """Raise `Failure` with the mistake and the usage of the command."""
        raise Failure(f"{self.prog}: {message}; usage: {USAGE[self.prog]}", 2)


class RewindPrompt(cmd.Cmd):
    """The prompt of `rack rewind`, with a method for each of its commands.

    Attributes:
        failed_count: Number of commands that failed.
    """

    def __init__(self, run: RewoundRun, as_json: bool) -> None:
        super().__init__()
        self._run = run
        self._as_json = as_json
        self.failed_count = 0

    @property
    def prompt(self) -> str:  # type: ignore[override]
        """Text of the prompt: the current simulated time."""
        return f"{self._run.to_time_s(self._run.tick):g} s> "

    def onecmd(self, line: str) -> bool:
        """Execute one command. Returns True if the prompt should end."""
        try:
            with convert_errors():
                # A signal that stopped a running branch also ends the prompt.
                return bool(super().onecmd(line)) or INTERRUPT.number != 0
        except Failure as failure:
            self._report_failure(str(failure))
        except OSError as error:
            self._report_failure(f"{error.filename}: {error.strerror}")
        return False

    def _report_failure(self, why: str) -> None:
        """Count and print a failure."""
        self.failed_count += 1
        text = to_one_line(why, MAX_LINE)
        print(encode_json({"error": text}) if self._as_json else text, flush=True)

    def _print_answer(self, answer: RewindAnswer) -> None:
        """Print an answer, as JSON or as lines."""
        if self._as_json:
            print(encode_json(answer.document), flush=True)
        else:
            print_text(answer.lines)

    def emptyline(self) -> bool:
        """Do nothing on an empty line, so that a branch is not repeated by accident."""
        return False

    def default(self, line: str) -> None:
        """Reject an unknown command. Raises `Failure` with the nearest commands."""
        if line.startswith("#"):
            return
        name = line.split()[0]
        near = get_close_matches(name, USAGE, 1) or USAGE
        raise Failure(f"{name}: no such command; nearest: {', '.join(near)}", 2)

    def do_goto(self, line: str) -> None:
        """Go to a simulated time in s, or to the next tick at which a condition begins to hold.

        A condition begins to hold at the first message that meets it after one that does not.
        Comparisons: == != <= >= < >; a state may be named, as in "primitive.status.state ==
        holding".
        """
        arguments = _parse_arguments("goto", line)
        if (arguments.time is None) == (arguments.when is None):
            raise Failure(f"goto: usage: {USAGE['goto']}", 2)
        if arguments.when is not None:
            self._print_answer(self._run.go_to_condition(" ".join(arguments.when)))
        else:
            self._print_answer(self._run.go_to_time(arguments.time))

    def do_step(self, line: str) -> None:
        """Go forward by one tick, or by TICKS."""
        self._print_answer(self._run.step(_parse_arguments("step", line).ticks))

    def do_back(self, line: str) -> None:
        """Go back by one tick or by TICKS, or to the tick at which a condition last began to hold.

        Conditions are written as for goto.
        """
        arguments = _parse_arguments("back", line)
        if arguments.when is not None:
            self._print_answer(self._run.go_to_condition(" ".join(arguments.when), back=True))
        else:
            self._print_answer(self._run.step(-arguments.ticks))

    def do_show(self, line: str) -> None:
        """Show a message, one of its signals, or the object of a level at this tick.

        The name can be a mailbox, as in primitive.status, or primitive.plan for the plan; a signal,
        as in servo.status.position[2]; or a task, as in primitive or primitive.planner, for the
        attributes of the level's object.
        """
        self._print_answer(self._run.show_name(_parse_arguments("show", line).name))

    def complete_show(self, text: str, line: str, begin: int, end: int) -> Sequence[str]:
        """List the names that begin with `text`, for completion."""
        return [name for name in self._run.names if name.startswith(text)]

    def do_events(self, line: str) -> None:
        """Show the events within SECONDS before and after this tick, by default 1 s."""
        self._print_answer(self._run.list_events(_parse_arguments("events", line).seconds))

    def do_branch(self, line: str) -> None:
        """Run the rack from this tick with other settings or faults, and record it as a new run.

        The answer states where the branch first differs. --seconds counts from the beginning of the
        run. By default the branch lasts as long as the run if that had a time limit, and otherwise
        ends with its task.
        """
        arguments = _parse_arguments("branch", line)
        with open_display(self._as_json, sys.stdout) as display:
            answer = self._run.run_branch(
                arguments.set, arguments.faults, arguments.out, arguments.seconds, display
            )
        self._print_answer(answer)

    def do_help(self, arg: str) -> None:
        """List the commands, or explain one."""
        if arg and arg not in USAGE:
            self.default(arg)
        lines = list(USAGE.values())
        if arg:
            lines = [USAGE[arg], cleandoc(getattr(self, f"do_{arg}").__doc__)]
        self._print_answer(RewindAnswer({"help": "\n".join(lines)}, lines))

    def do_quit(self, line: str) -> bool:
        """Leave the prompt. The end of the input does the same."""
        return True

    def do_EOF(self, line: str) -> bool:  # noqa: N802  the name that `cmd` gives the end of input
        """Leave the prompt at the end of the input."""
        print()
        return True


def _parse_seconds(text: str) -> float:
    """Parse a time in s. Raises `ArgumentTypeError`."""
    with suppress(ValueError):
        if 0.0 <= (seconds := float(text)) <= MAX_SECONDS:
            return seconds
    raise argparse.ArgumentTypeError(f"{text}: must be 0 to {MAX_SECONDS:g} s")


def _parse_ticks(text: str) -> int:
    """Parse a number of ticks. Raises `ArgumentTypeError`."""
    with suppress(ValueError):
        if abs(ticks := int(text)) <= LAST_TICK:
            return ticks
    raise argparse.ArgumentTypeError(f"{text}: must be -{LAST_TICK} to {LAST_TICK} ticks")


_WHEN = {"nargs": "+"}
_TICKS = {"nargs": "?", "type": _parse_ticks, "default": 1}
ARGUMENTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "goto": {"time": {"nargs": "?"}, "--when": _WHEN},
    "step": {"ticks": _TICKS},
    "back": {"ticks": _TICKS, "--when": _WHEN},
    "show": {"name": {}},
    "events": {"seconds": {"nargs": "?", "type": _parse_seconds, "default": 1.0}},
    "branch": {
        "--set": {"action": "append", "default": []},
        "--faults": {},
        "--seconds": {"type": _parse_seconds},
        "--out": {"type": Path},
    },
}
"""Arguments of each command, in the form that `argparse` takes."""


def _parse_arguments(command: str, line: str) -> argparse.Namespace:
    """Parse the arguments of a command. Raises `Failure`."""
    parser = _ArgumentParser(command, add_help=False, allow_abbrev=False)
    for name, settings in ARGUMENTS[command].items():
        parser.add_argument(name, **settings)
    try:
        words = shlex.split(line, comments=True)
    except ValueError as error:
        raise Failure(f"{command} {line}: {error}", 2) from None
    return parser.parse_args(words)
