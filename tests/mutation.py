"""Do the tests notice a small mistake? `python -m tests.mutation --seed 7 --count 100`: by hand, it
takes an hour.

Each mutant is a copy of the tree with one random change in one file: a comparison flipped, a
statement dropped, a number greater, `and` for `or`, a condition negated, a sign. The tests that
mirror the file must fail on it, or the digest of a shipped rack must change. What no test is to
notice is not changed: annotations, messages, numbers of enumeration members, lengths of time-outs,
when garbage is collected, `strict` of `zip`, and how a picture is drawn (`plot.py`).

A test that fails on the unchanged copy as well kills nothing: it is left out, and the mutant is
examined again. Tests marked `alone` are left out too: they judge the machine.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from queue import SimpleQueue

from tests.mutants import COPIED, ROOT, environment, mutated
from tests.processes import runs

PACKAGES = ("backplane", "boards", "levels", "tools")
TESTS = sorted((ROOT / "tests").rglob("test_*.py"))
FEW = 8
"""Files of tests for one mutant, at most, besides its mirrored folder."""
GOLDEN = "tests/test_golden.py"
"""Whole runs of shipped racks: their digests change with what any board or level writes."""
QUICK = "not alone and not slow and not thorough"
SLOW = "not alone and (slow or thorough)"
BOUND_S, TEST_BOUND_S = 900, 60
"""Time for the tests of one mutant, and for each of them: a test beyond has timed out."""
PAIRS = (("==", "!="), ("is", "is not"), ("in", "not in"), ("and", "or"), ("+", "-"))
FLIPPED = {"<": "<=", "<=": "<", ">": ">=", ">=": ">", **dict(PAIRS)}
FLIPPED |= {other: one for one, other in PAIRS}
OPERATOR = re.compile(
    r"==|!=|<=|>=|<|>|\bis\s+not\b|\bis\b|\bnot\s+in\b|\bin\b|\band\b|\bor\b|\+|-"
)
RUNNING: set[int] = set()
"""Sessions of runs."""
TIME_OUT = re.compile(r"(?i:_?(?:bound|wait|time_?out|patience)\w*)|[A-Z_]+_S")
"""Names of real times to wait, to look again, to give up."""


@dataclass(frozen=True)
class Mutation:
    """A span of a file's bytes and what stands there instead."""

    file: str
    start: int
    end: int
    new: str

    def patch(self) -> tuple[str, str, str]:
        """Return the file, its text, and its text with the mutation."""
        text = (ROOT / self.file).read_bytes()
        mutated = text[: self.start] + self.new.encode() + text[self.end :]
        return self.file, text.decode(), mutated.decode()

    def __str__(self) -> str:
        """Return file, line, and the line before and after."""
        _, old, new = self.patch()
        row = old.encode()[: self.start].count(b"\n")
        before, after = (text.splitlines()[row].strip() for text in (old, new))
        return f"{self.file}:{row + 1}: {before} → {after}"


class Mutations:
    """The mutations of one file."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.text = (ROOT / file).read_bytes()
        self.lines = [0]
        for line in self.text.splitlines(keepends=True):
            self.lines.append(self.lines[-1] + len(line))

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        """Return the bytes of a node."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return (
            self.lines[node.lineno - 1] + node.col_offset,
            self.lines[node.end_lineno - 1] + node.end_col_offset,
        )

    def of(self, node: ast.AST) -> Iterator[Mutation]:  # noqa: C901  # one match of all kinds
        """Yield the mutations of a node and of all below it that may matter."""
        match node:
            case (
                ast.Expr(value=ast.Call(func=ast.Attribute(value=ast.Name("gc"))))
                | ast.Expr(value=ast.Constant())
                | ast.If(test=ast.Name("TYPE_CHECKING"))
                | ast.keyword(arg="strict")
            ):
                return
            case ast.Compare(left=left, comparators=[right]):
                yield from self._operator(left, right)
            case ast.BoolOp(values=values):
                yield from self._operator(values[0], values[1])
            case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right) if not _is_text(
                left
            ) | _is_text(right):
                yield from self._operator(left, right)
            case ast.UnaryOp(op=ast.Not() | ast.USub() as op):
                start = self.span(node)[0]
                yield self._mutation(
                    start, start + len("not" if isinstance(op, ast.Not) else "-"), ""
                )
            case ast.Constant(value=bool() as value):
                yield self._mutation(*self.span(node), str(not value))
            case ast.Constant(value=int() | float() as value):
                # One more of a thousand million is no other number of ns.
                yield self._mutation(*self.span(node), repr(value + max(1, value // 2)))
            case (
                ast.Expr()
                | ast.AugAssign()
                | ast.Raise()
                | ast.Continue()
                | ast.Break()
                | ast.Return(value=None)
            ):
                yield self._dropped(node)
            case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
                yield self._dropped(node)
            case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
                if not isinstance(test, ast.Compare | ast.UnaryOp | ast.Constant):
                    start, end = self.span(test)
                    yield self._mutation(start, end, f"(not ({self.text[start:end].decode()}))")
        for child in _children(node):
            yield from self.of(child)

    def _operator(self, left: ast.expr, right: ast.expr) -> Iterator[Mutation]:
        start, end = self.span(left)[1], self.span(right)[0]
        if found := OPERATOR.search(self.text[start:end].decode()):
            yield self._mutation(
                start + found.start(), start + found.end(), FLIPPED[" ".join(found[0].split())]
            )

    def _dropped(self, statement: ast.stmt) -> Mutation:
        start, end = self.span(statement)
        # As many lines as before, so that tracebacks name the lines of the source.
        return self._mutation(start, end, "pass" + "\n" * self.text.count(b"\n", start, end))

    def _mutation(self, start: int, end: int, new: str) -> Mutation:
        return Mutation(self.file, start, end, new)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def _children(node: ast.AST) -> Iterator[ast.AST]:  # noqa: C901  # one match of all kinds
    """Yield the children that a test could notice."""
    match node:
        # The positions within an f-string are wrong before Python 3.12, and it is text.
        case ast.JoinedStr() | ast.Raise() | ast.Import() | ast.ImportFrom() | ast.Assert():
            return
        case ast.If(test=ast.Compare(left=ast.Name("__name__"))):
            return
        case ast.Call(func=ast.Name("print" | "cast" | "TypeVar" | "warn")):
            return
        case ast.FunctionDef(args=args):
            named = [*args.posonlyargs, *args.args]
            defaults = [*zip(reversed(named), reversed(args.defaults), strict=False)]
            defaults += [
                (arg, value)
                for arg, value in zip(args.kwonlyargs, args.kw_defaults, strict=True)
                if value
            ]
            yield from (value for arg, value in defaults if not TIME_OUT.fullmatch(arg.arg))
            yield from _statements(node.body)
        case ast.ClassDef(body=body):
            is_enum = any(
                "Enum" in ast.unparse(base) or "Flag" in ast.unparse(base) for base in node.bases
            )
            yield from (
                item for item in _statements(body) if not (is_enum and isinstance(item, ast.Assign))
            )
        case ast.BinOp(left=ast.Name(name), op=ast.Mult()) if TIME_OUT.fullmatch(name):
            # In other units it is a time-out still.
            return
        case ast.AnnAssign(target=target, value=value):
            if value and not (isinstance(target, ast.Name) and TIME_OUT.fullmatch(target.id)):
                yield value
        case ast.Assign(targets=[ast.Name(id=name)]) if name.startswith("__") or TIME_OUT.fullmatch(
            name
        ):
            return
        case ast.Module(body=body):
            yield from _statements(body)
        case _:
            yield from ast.iter_child_nodes(node)


def _statements(body: Sequence[ast.stmt]) -> Iterator[ast.stmt]:
    """Yield the statements that are no docstrings."""
    yield from (
        item
        for item in body
        if not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))
    )


@cache
def _imports(test: Path) -> frozenset[str]:
    """Return what a file imports: modules, and each name with its module before it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(test.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return frozenset(found)


def _names(file: str) -> set[str]:
    """Return a module's name, and those of what it defines, as the packages around it may hand them
    on."""
    module = ".".join(("rack", *Path(file).with_suffix("").parts)).removesuffix(".__init__")
    defined = [
        item.name for item in ast.parse((ROOT / file).read_text()).body if hasattr(item, "name")
    ]
    above = [module.rsplit(".", level)[0] for level in range(1, module.count("."))]
    return {module} | {f"{package}.{name}" for package in above for name in defined}


@cache
def mirrors(file: str) -> list[str]:
    """Return the files of tests nearest to a source: its mirror, those named after it, the rest of
    the mirrored folder, and a few importers of it.

    Then those that import its importers: not all that a module does is seen from within it.
    """
    path, names = Path(file), _names(file)
    folder, title = ROOT / "tests" / path.parent, path.stem
    titles = {
        f"test_{path.parent.name}_{title}",
        f"test_{path.parent.name.removesuffix('s')}_{title}",
    }
    sources = [
        source
        for floor in COPIED
        for source in (ROOT / floor).rglob("*.py")
        if names & _imports(source)
    ]
    through = {name for source in sources for name in _names(str(source.relative_to(ROOT)))}

    def likeness(test: Path) -> int:
        if test == folder / f"test_{title}.py" or (
            test.stem in titles and folder.is_relative_to(test.parent)
        ):
            return 0
        is_importer = bool(names & _imports(test))
        if is_importer and test.stem.startswith(f"test_{title}"):
            return 1
        if test.parent == folder:
            return 2 if is_importer else 3
        return 4 if is_importer else 5 if through & _imports(test) else 6

    def distance(test: Path) -> int:
        shared = len(Path(os.path.commonpath([test, folder])).parts)
        return len(test.parts) + len(folder.parts) - 2 * shared

    ranked = sorted((likeness(test), distance(test), str(test.relative_to(ROOT))) for test in TESTS)
    near = sum(rank <= 3 for rank, _, _ in ranked)
    return [test for _, _, test in ranked[: near + FEW]]


@dataclass(frozen=True)
class Verdict:
    """What the tests said of a copy, and those that failed."""

    word: str
    failed: tuple[str, ...] = ()


def tested(folder: Path, options: Sequence[str], marks: str) -> Verdict:
    """Run tests on the copy in a folder, in a session of their own; nothing of it stays."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n0", "-p", "no:cacheprovider"]
    command += ["-m", marks, f"--timeout={TEST_BOUND_S}"]
    command += [f"--basetemp={folder / 'files'}", *options]
    output = folder / "output"
    with output.open("w") as out:
        run = subprocess.Popen(
            command,
            cwd=folder / "rack",
            env=environment(folder),
            stdout=out,
            stderr=out,
            start_new_session=True,
        )
        RUNNING.add(run.pid)
        try:
            status = run.wait(BOUND_S)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            _clear(run, folder)
    text = output.read_text(errors="replace")
    pattern = r"^(?:FAILED|ERROR) (\S+\.py(?:::[^\s\[]+(?:\[.*?\](?= - |$))?)?)"
    failed = tuple(re.findall(pattern, text, re.MULTILINE))
    # 5: all tests that there are were left out.
    if status in (0, 5):
        return Verdict("survived")
    if status == 4 and "while loading conftest" in text:
        # It cannot be imported.
        return Verdict("killed")
    if status == 4 and "ERROR: not found" in text:
        return Verdict("not found")
    if status is not None and status < 0:
        # It has crashed the interpreter, in shared memory or MuJoCo: no test passes over that.
        return Verdict("killed")
    if status is not None and not failed:
        # No test has failed: nothing was tested.
        raise SystemExit(f"pytest ended with status {status}:\n{text[-2000:]}")
    if status is None:
        # No test has ended it.
        return Verdict("undecided")
    return Verdict("timed out" if "Failed: Timeout" in text else "killed", failed)


def _clear(run: subprocess.Popen[bytes], folder: Path) -> None:
    """End the processes of a run, whatever session they are in, and remove its racks, which are
    named after it."""
    RUNNING.discard(run.pid)
    _kill(run.pid)
    run.wait()
    mark = f"PYTHONPATH={folder}".encode()
    for path in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if mark in path.read_bytes().split(b"\0") and runs(int(path.parent.name)):
                os.kill(int(path.parent.name), signal.SIGKILL)
    for pattern in (f"*nasrem-rack.*-{run.pid}", f"*nasrem-rack.*-{run.pid}-*"):
        for left in Path("/dev/shm").glob(pattern):
            left.unlink(missing_ok=True)


def _kill(session: int) -> None:
    with suppress(ProcessLookupError):
        os.killpg(session, signal.SIGKILL)


@dataclass
class Bench:
    """A folder for mutated copies, one after the other, and one with the unchanged tree."""

    folder: Path
    sound: dict[str, bool] = field(default_factory=dict)
    """Whether a test passes on the unchanged tree."""

    def examined(self, mutation: Mutation) -> str:
        """Return what became of a mutant: killed, survived, timed out, undecided.

        Quick tests come first: most mutants are noticed by one.
        """
        word = self._examined_by(QUICK, mutation)
        return self._examined_by(SLOW, mutation) if word == "survived" else word

    def _examined_by(self, marks: str, mutation: Mutation) -> str:
        tests, left_out = mirrors(mutation.file), set[str]()
        if marks == SLOW and not mutation.file.startswith("tools/") and GOLDEN not in tests:
            tests = [*tests, GOLDEN]
        # One path for all copies: code that is compiled is kept by it.
        self._copy([mutation.patch()])
        while True:
            deselected = (f"--deselect={test}" for test in left_out)
            verdict = tested(self.folder, [*tests, *deselected], marks)
            broken = {test for test in verdict.failed if "::" in test} - left_out
            if verdict.word != "killed" or not broken:
                return verdict.word
            unknown = sorted(broken - self.sound.keys())
            if unknown:
                self._copy([])
                self.sound |= {test: self._is_sound(test) for test in unknown}
                self._copy([mutation.patch()])
            if any(self.sound[test] for test in broken):
                return verdict.word
            left_out |= broken

    def _is_sound(self, test: str) -> bool:
        """Say whether a test passes on the copy. A mutant may have changed a parameter in its
        name: then all parameters count."""
        verdict = tested(self.folder, [test], "not alone")
        if verdict.word == "not found":
            verdict = tested(self.folder, [test.partition("[")[0]], "not alone")
        return verdict.word == "survived"

    def _copy(self, patches: Sequence[tuple[str, str, str]]) -> None:
        shutil.rmtree(self.folder / "rack", ignore_errors=True)
        mutated(self.folder, patches, (*COPIED, "tests"))
        for name in ("pyproject.toml", "README.md"):
            shutil.copy2(ROOT / name, self.folder / "rack" / name)


def main() -> int:
    """Examine random mutants and print what became of each; return 1 when fewer than nine in ten
    were noticed."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutation", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument(
        "--only", nargs="+", default=PACKAGES, metavar="PATH", help="files or folders"
    )
    options = parser.parse_args()
    paths = [ROOT / name for name in options.only]
    files = sorted(
        {file for path in paths for file in ([path] if path.is_file() else path.rglob("*.py"))}
    )
    names = [str(file.relative_to(ROOT)) for file in files if file.name != "plot.py"]
    sites = [
        site for name in names for site in Mutations(name).of(ast.parse((ROOT / name).read_text()))
    ]
    chosen = random.Random(options.seed).sample(sites, min(options.count, len(sites)))
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        benches: SimpleQueue[Bench] = SimpleQueue()
        for number in range(options.jobs):
            benches.put(Bench(Path(folder) / str(number)))

        def examine(mutation: Mutation) -> None:
            bench, began = benches.get(), time.monotonic()
            try:
                word = bench.examined(mutation)
            finally:
                benches.put(bench)
            counts[word] += 1
            took_s = time.monotonic() - began
            print(f"{counts.total():3} {word} ({took_s:.0f} s): {mutation}", flush=True)

        with ThreadPoolExecutor(options.jobs) as pool:
            # Started in the background of a shell, it would ignore SIGINT.
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda number, frame: sys.exit(128 + number))
            try:
                list(pool.map(examine, chosen))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                for session in tuple(RUNNING):
                    _kill(session)
                raise
    words = ", ".join(f"{n} {word}" for word, n in counts.items())
    print(f"seed {options.seed}, of {len(sites)} possible: {words}")
    # A test that hangs fails by its time-out: it has noticed.
    noticed = counts["killed"] + counts["timed out"]
    return 0 if 10 * noticed >= 9 * len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
