"""Config files: found by name or path, merged with the files that they extend, with absolute
paths.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from rack.backplane.bounded_toml import MAX_DEPTH
from rack.backplane.regular_file import read_regular_file
from rack.boards.config.toml import Tables, merge, override, parse, table_of
from rack.boards.errors import ConfigError, Mistake

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
"""The bundled configs: next to this package in a checkout and in an installation."""
FAULTS = CONFIGS / "faults"
"""Bundled fault scripts, for `--faults`."""
MAX_FILE_BYTES = 1_000_000
LAN_ADAPTER = "rack.boards.lan.adapter:LanAdapter"
"""Class of the board that `[adapter.lan]` adds."""
ANY = "*"
STATE_TABLES = ("board", ANY, "params", "tables", ANY)
"""Place of the files of levels' state tables; `ANY` stands for any key."""
EXTENDS = "configs that this file extends, by name or path, in order; its own keys override theirs"
"""Meaning of `extends`, the one key that only files have."""


@dataclass(frozen=True)
class Assembled:
    """The tables of a config as they were read.

    Attributes:
        tables: The tables.
        mistakes: Mistakes in files, fault script and settings.
        broken: Tables that settings with mistakes were to change.
        is_whole: False if files are missing, with tables that nobody knows.
    """

    tables: Tables
    mistakes: Sequence[Mistake] = ()
    broken: frozenset[str] = frozenset()
    is_whole: bool = True


def assembled(
    name_or_path: str | Path, overrides: Sequence[str], faults: str | Path | None
) -> Assembled:
    """Return the tables of a config by name or path, with `key.sub=value` overrides and the faults
    of a script. Paths in an override are relative to the current folder.
    """
    mistakes: list[Mistake] = []
    tables: Tables = {}
    folder = CONFIGS
    with gathering(mistakes):
        path = _path(name_or_path, "config", CONFIGS)
        folder = path.parent
        tables = _read(path, (), {}, mistakes)
    is_whole = not mistakes
    if faults is not None:
        with gathering(mistakes):
            tables = with_faults(tables, faults, folder)
    wrong: list[Mistake] = []
    overridden = override(tables, overrides, wrong)
    # Settings may refer to what only the files hold.
    found = anchor(overridden if is_whole else tables, Path.cwd())
    broken = frozenset(table_of(setting.value) for setting in wrong)
    return Assembled(found, [*mistakes, *wrong], broken, is_whole)


@contextmanager
def gathering(mistakes: list[Mistake]) -> Iterator[None]:
    """Add the mistakes of a `ConfigError` to a list."""
    try:
        yield
    except ConfigError as error:
        mistakes += error.mistakes


def named_classes(tables: Tables) -> tuple[str, ...]:
    """Return the classes of levels that tables name, as "package.module:Class"; nothing else in
    them is checked.
    """
    boards = [board for board in _table(tables, "board").values() if isinstance(board, dict)]
    names = [board.get(role) for board in boards for role in ("executor", "planner")]
    names += [LAN_ADAPTER] if "lan" in _table(tables, "adapter") else []
    return tuple(dict.fromkeys(name for name in names if isinstance(name, str)))


def with_faults(tables: Tables, name_or_path: str | Path, own: Path) -> Tables:
    """Return config tables with the faults of a script appended.

    A script contains `[[fault]]` tables and nothing else. A name means a script in the folder of
    the rack, `own`, if it has one of its own, else a bundled script. Raises `ConfigError`.
    """
    folders = [FAULTS] if own == CONFIGS else [own, FAULTS]
    path = _path(name_or_path, "--faults", *folders)
    script = _tables(path)
    wrong = [
        Mistake(
            f"{path.name}: {key}", None, "a fault script contains [[fault]] tables and nothing else"
        )
        for key, value in script.items()
        if key != "fault" or not isinstance(value, list)
    ]
    if wrong:
        raise ConfigError(wrong)
    faults = tables.get("fault")
    if not isinstance(faults, list):
        faults = []
    return {**tables, "fault": [*faults, *script.get("fault", [])]}


def names(folder: Path = CONFIGS) -> list[str]:
    """Return the names of the bundled racks, or of the configs in another folder.

    A config is `<name>.toml`, or `<name>/<name>.toml`, next to its page. Other racks in that
    folder, files with a name of their own, are `<name>/<rack>`.
    """
    found = [path.stem for path in folder.glob("*.toml")]
    for main in (path for path in folder.glob("*/*.toml") if path.stem == path.parent.name):
        racks = [
            path.stem
            for path in main.parent.glob("*.toml")
            if path == main or "name" in _tables(path)
        ]
        found += [main.stem if rack == main.stem else f"{main.stem}/{rack}" for rack in racks]
    return sorted(found)


def file_at(path: Path) -> Path | None:
    """Return the absolute path of a file, which need not be a regular one; None if it does not
    exist or the path is invalid (unknown ~user).
    """
    try:
        path = path.expanduser()
        if path.is_file():
            return path.resolve()
        # Keep the name as given: the file may be a link to a device.
        return path.absolute() if path.exists() and not path.is_dir() else None
    except (OSError, RuntimeError, ValueError):
        return None


def anchor(tables: Tables, folder: Path) -> Tables:
    """Return the tables with absolute paths, resolved from `folder`, or for a bundled file from
    configs/.
    """

    def find(text: str) -> str:
        return str(_find(text, folder) or folder / text)

    tables = with_texts(tables, ("robot", "model"), find)
    tables = with_texts(tables, ("python_path",), lambda text: str((folder / text).resolve()))
    tables = with_texts(tables, ("adapter", ANY, "certificates"), lambda text: str(folder / text))
    racks = ("adapter", ANY, "launch")
    tables = with_texts(tables, racks, lambda text: str(_find(text, folder) or text))
    anchored: Tables = with_texts(tables, STATE_TABLES, find)
    return anchored


def with_texts(value: Any, keys: Sequence[str], change: Callable[[str], str]) -> Any:
    """Return tables with `change` applied to the text at a place, or to each text of a list there;
    whatever else is there stays.
    """
    if keys and isinstance(value, dict):
        key, *rest = keys
        return {
            name: with_texts(item, rest, change) if key in (name, ANY) else item
            for name, item in value.items()
        }
    if not keys and isinstance(value, list):
        return [with_texts(item, (), change) for item in value]
    return change(value) if not keys and isinstance(value, str) else value


def _table(tables: Tables, key: str) -> Tables:
    """Return the table of a key; an empty one if there is none, or something else."""
    found = tables.get(key)
    return found if isinstance(found, dict) else {}


def portable(model: Path) -> str:
    """Return a model's path as written in a config: for a bundled model, relative to configs/."""
    return model.relative_to(CONFIGS).as_posix() if model.is_relative_to(CONFIGS) else str(model)


def _path(name_or_path: str | Path, place: str, *folders: Path) -> Path:
    text = str(name_or_path)
    is_path = isinstance(name_or_path, Path) or "/" in text or text.endswith(".toml")
    if is_path and (file := file_at(Path(text))):
        return file
    # Only what is no file is looked for among the names: that reads every config.
    if is_path:
        known = [folder for folder in folders if text in names(folder)]
    else:
        known = [*folders, Path.cwd()]
    found = next((file for folder in known if (file := _named(text, folder))), None)
    if found is None:
        known_names = names(folders[-1])
        near = get_close_matches(text, known_names, 1)
        by_name = f"by name: {', '.join(known_names)}; or a path"
        why = f"did you mean '{near[0]}'?" if near else by_name
        raise ConfigError([Mistake(place, text, f"no such file; {why}")])
    return found


def _read(
    path: Path, chain: tuple[Path, ...], known: dict[Path, Tables], mistakes: list[Mistake]
) -> Tables:
    """Read a file and merge its tables into the tables of the files that it extends.

    Args:
        path: The file.
        chain: The files that extend it, directly or not.
        known: Files read before, which may be extended more than once.
        mistakes: Gets every mistake.
    """
    if path not in known:
        with gathering(mistakes):
            known[path] = _merged(path, chain, known, mistakes)
    return known.setdefault(path, {})


def _merged(
    path: Path, chain: tuple[Path, ...], known: dict[Path, Tables], mistakes: list[Mistake]
) -> Tables:
    if path in chain:
        loop = " -> ".join(p.name for p in (*chain[chain.index(path) :], path))
        raise ConfigError([Mistake(f"{path.name}: extends", None, f"extends itself: {loop}")])
    if len(chain) >= MAX_DEPTH:
        why = f"chain of extends too long; permitted: {MAX_DEPTH} files"
        raise ConfigError([Mistake(f"{path.name}: extends", None, why)])
    # Its own: a file may extend newer ones.
    own = {"format": 1, **anchor(_tables(path), path.parent)}
    merged: Tables = {}
    for base in _bases(own.pop("extends", []), path, mistakes):
        merged = _extended(merged, _read(base, (*chain, path), known, mistakes))
    return _extended(merged, own)


def _extended(base: Tables, top: Tables) -> Tables:
    """Return a file's tables merged over those it extends; a [robot] with its own model replaces
    the arm.
    """
    if "model" in _table(top, "robot"):
        base = {key: value for key, value in base.items() if key != "robot"}
    return merge(base, top)


def _tables(path: Path) -> Tables:
    try:
        text = read_regular_file(path, MAX_FILE_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", error)
        raise ConfigError([Mistake(str(path), None, f"cannot be read: {why}")]) from None
    return parse(text, path.name)


def _bases(extends: Any, path: Path, mistakes: list[Mistake]) -> list[Path]:
    place = f"{path.name}: extends"
    if not isinstance(extends, list) or not all(isinstance(item, str) for item in extends):
        raise ConfigError([Mistake(place, extends, "must be a list of config names or paths")])
    bases = []
    for item in extends:
        base = _find(item, path.parent) or _find(f"{item}.toml", path.parent) or _named(item)
        if base is None:
            known = ", ".join(names())
            why = f"no such file next to {path.name} or among the bundled configs: {known}"
            mistakes.append(Mistake(place, item, why))
        else:
            bases.append(base)
    return bases


def _named(name: str, folder: Path = CONFIGS) -> Path | None:
    """Return the config of that name in a folder."""
    return file_at(folder / f"{name}.toml") or file_at(folder / name / f"{name}.toml")


def _find(reference: str, folder: Path) -> Path | None:
    """Return the file that a config in `folder` refers to: next to it, else among the bundled
    ones.
    """
    return file_at(folder / reference) or file_at(CONFIGS / reference)
