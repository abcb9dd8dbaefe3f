"""`rack rewind`: go through a recorded run, to any tick, and branch off there."""

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
from rack.boards.errors import one_line
from rack.levels.tables import LAST_TICK
from rack.tools.console.answer import MAX_LINE, Failure, as_failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Anyway, Json, RunFolder
from rack.tools.monitor.display import display_for
from rack.tools.scripting.rewound import Glance, RewoundRun

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
MOST_S = 1e9


def rewind(run: RunFolder, anyway: Anyway = False, as_json: Json = False) -> None:
    r"""Go back to any tick of a recorded run, see what was in force there and what the levels held
    in their own objects, and branch off.

    It opens a prompt; commands may come from stdin, too, one a line. With --json each answer is a
    document on one line, that of a command that fails an object with 'error'.

    \b
      goto 12.5, goto --when "servo.status.position[2] > 1.2"
      step [TICKS], back [TICKS], back --when CONDITION
      show primitive.status, show primitive.plan, show servo.status.position[2]
      show primitive          the attributes of the level's own object
      events [SECONDS]        what happened around this tick
      branch [--set KEY=VALUE]... [--faults FILE] [--seconds S] [--out DIR]
      help [COMMAND], quit

    A tick is shown as it is before its tasks begin: messages are those that they then read.
    Messages and events come from the recording. For the objects of levels, and branches, the rack
    runs again unchanged, from the beginning or from where it was before. RUN is only read.

    Exit status: 0 the prompt was left; of commands from stdin or with --json: 0 all worked, 2 one
    failed; 2 RUN is not a run.

    \b
    Examples:
      rack rewind runs/whole
      printf 'goto 12.5\\nshow servo.status\\n' | rack rewind runs/whole --json
    """
    with INTERRUPT.raising(), RewoundRun(run, anyway) as rewound:
        prompt = RewindPrompt(rewound, as_json)
        if sys.stdin.isatty() and not as_json:
            with suppress(ImportError):
                import readline  # noqa: F401  line editing and history
            prompt.cmdloop(f"{run}; 'help' lists the commands")
            return
        for line in sys.stdin:
            if prompt.onecmd(line):
                break
    if prompt.failed:
        sys.exit(2)


class _Arguments(argparse.ArgumentParser):
    """The arguments of a command at the prompt: a mistake is one line, and no end."""

    def error(self, message: str) -> NoReturn:
        """Raise `Failure`."""
        raise Failure(f"{self.prog}: {message}; permitted: {USAGE[self.prog]}", 2)


class RewindPrompt(cmd.Cmd):
    """The commands of the prompt; `failed` counts those that did not work."""

    def __init__(self, run: RewoundRun, as_json: bool) -> None:
        super().__init__()
        self._run = run
        self._as_json = as_json
        self.failed = 0

    @property
    def prompt(self) -> str:  # type: ignore[override]
        """Where one is."""
        return f"{self._run.time_s(self._run.tick):g} s> "

    def onecmd(self, line: str) -> bool:
        """Do one command; return True for the last."""
        try:
            with as_failure():
                # A branch that a signal has ended was the last command.
                return bool(super().onecmd(line)) or INTERRUPT.number != 0
        except Failure as failure:
            self._fail(str(failure))
        except OSError as error:
            self._fail(f"{error.filename}: {error.strerror}")
        return False

    def _fail(self, why: str) -> None:
        self.failed += 1
        text = one_line(why, MAX_LINE)
        print(encode_json({"error": text}) if self._as_json else text, flush=True)

    def _answer(self, found: Glance) -> None:
        if self._as_json:
            print(encode_json(found.document), flush=True)
        else:
            print(*found.lines, sep="\n", flush=True)

    def emptyline(self) -> bool:
        """Do nothing: a branch is not repeated by accident."""
        return False

    def default(self, line: str) -> None:
        """Name the nearest command. Raises `Failure`."""
        if line.startswith("#"):
            return
        name = line.split()[0]
        near = get_close_matches(name, USAGE, 1) or USAGE
        raise Failure(f"{name}: no such command; nearest: {', '.join(near)}", 2)

    def do_goto(self, line: str) -> None:
        """Go to a simulated time, s; or on to the next tick at which readers find that a condition
        has begun to hold: it did not in the message before. Comparisons: == != <= >= < >; a state
        may be named, as in "primitive.status.state == holding".
        """
        given = _given("goto", line)
        if (given.time is None) == (given.when is None):
            raise Failure(f"goto: permitted: {USAGE['goto']}", 2)
        if given.when is not None:
            self._answer(self._run.goto_when(" ".join(given.when)))
        else:
            self._answer(self._run.goto(given.time))

    def do_step(self, line: str) -> None:
        """Go on by a tick, or by so many."""
        self._answer(self._run.step(_given("step", line).ticks))

    def do_back(self, line: str) -> None:
        """Go back by a tick, or by so many; or to the last tick before this one at which a
        condition began to hold, as with goto.
        """
        given = _given("back", line)
        if given.when is not None:
            self._answer(self._run.goto_when(" ".join(given.when), back=True))
        else:
            self._answer(self._run.step(-given.ticks))

    def do_show(self, line: str) -> None:
        """Show the message in force in a mailbox, as in primitive.status, or primitive.plan for the
        plan; one signal in it, as in servo.status.position[2]; or, by the name of a task, as in
        primitive or primitive.planner, the attributes of the level's own object at this tick.
        """
        self._answer(self._run.show(_given("show", line).name))

    def complete_show(self, text: str, line: str, begin: int, end: int) -> Sequence[str]:
        """Return the names that may follow."""
        return [name for name in self._run.names if name.startswith(text)]

    def do_events(self, line: str) -> None:
        """Show the events at most so long before and after this tick; 1 s unless given."""
        self._answer(self._run.events(_given("events", line).seconds))

    def do_branch(self, line: str) -> None:
        """Let the rack go on from this tick with other settings or faults, record that as a run of
        its own, and say where it first differs. --seconds counts from the beginning of the run;
        default: until the task ends, or for as long as the run was.
        """
        given = _given("branch", line)
        with display_for(silent=self._as_json) as display:
            found = self._run.branch(given.set, given.faults, given.out, given.seconds, display)
        self._answer(found)

    def do_help(self, arg: str) -> None:
        """List the commands, or explain one."""
        if arg and arg not in USAGE:
            self.default(arg)
        lines = list(USAGE.values())
        if arg:
            lines = [USAGE[arg], cleandoc(getattr(self, f"do_{arg}").__doc__)]
        self._answer(Glance({"help": "\n".join(lines)}, lines))

    def do_quit(self, line: str) -> bool:
        """Leave the prompt; so does the end of input."""
        return True

    def do_EOF(self, line: str) -> bool:  # noqa: N802  the name that `cmd` gives the end of input
        """End."""
        print()
        return True


def _seconds(text: str) -> float:
    """Return a time, s. Raises `ArgumentTypeError`."""
    with suppress(ValueError):
        if 0.0 <= (found := float(text)) <= MOST_S:
            return found
    raise argparse.ArgumentTypeError(f"{text}: permitted: 0 to {MOST_S:g} s")


def _ticks(text: str) -> int:
    """Return a number of ticks. Raises `ArgumentTypeError`."""
    with suppress(ValueError):
        if abs(found := int(text)) <= LAST_TICK:
            return found
    raise argparse.ArgumentTypeError(f"{text}: permitted: at most {LAST_TICK} ticks, either way")


_WHEN = {"nargs": "+"}
_TICKS = {"nargs": "?", "type": _ticks, "default": 1}
ARGUMENTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "goto": {"time": {"nargs": "?"}, "--when": _WHEN},
    "step": {"ticks": _TICKS},
    "back": {"ticks": _TICKS, "--when": _WHEN},
    "show": {"name": {}},
    "events": {"seconds": {"nargs": "?", "type": _seconds, "default": 1.0}},
    "branch": {
        "--set": {"action": "append", "default": []},
        "--faults": {},
        "--seconds": {"type": _seconds},
        "--out": {"type": Path},
    },
}
"""Of each command its arguments, as `argparse` takes them."""


def _given(command: str, line: str) -> argparse.Namespace:
    """Return what is given to a command. Raises `Failure`."""
    parser = _Arguments(command, add_help=False, allow_abbrev=False)
    for name, how in ARGUMENTS[command].items():
        parser.add_argument(name, **how)
    try:
        words = shlex.split(line, comments=True)
    except ValueError as error:
        raise Failure(f"{command} {line}: {error}", 2) from None
    return parser.parse_args(words)
