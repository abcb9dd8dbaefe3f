"""Config files: found by name or path, and merged with the files that they extend."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from rack.backplane.bounded_toml import MAX_DEPTH
from rack.backplane.regular_file import read_regular_file
from rack.boards.config.toml import (
    Tables,
    apply_settings,
    find_table_name,
    merge_tables,
    parse_tables,
)
from rack.boards.errors import ConfigError, Mistake

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
"""The bundled configs: next to this package in a checkout and in an installation."""
FAULTS = CONFIGS / "faults"
"""Folder of the bundled fault scripts, for `--faults`."""
MAX_FILE_BYTES = 1_000_000
LAN_ADAPTER = "rack.boards.lan.adapter:LanAdapter"
"""Class of the board that `[adapter.lan]` adds."""
ANY = "*"
STATE_TABLES = ("board", ANY, "params", "tables", ANY)
"""Keys under which levels name the files of their state tables. `ANY` stands for any key."""
EXTENDS = "configs that this file extends, by name or path, in order; its own keys override theirs"
"""Meaning of the key `extends`, which may occur in a file but not in a loaded config."""


@dataclass(frozen=True)
class Assembled:
    """Tables of a config, merged from its files and settings but not yet validated.

    Attributes:
        tables: The tables, with absolute paths.
        mistakes: Mistakes in files, fault script and settings.
        broken: Tables that an invalid setting was meant to change.
        is_whole: False if files could not be read, so that tables may be missing.
    """

    tables: Tables
    mistakes: Sequence[Mistake] = ()
    broken: frozenset[str] = frozenset()
    is_whole: bool = True


def assemble(
    name_or_path: str | Path, overrides: Sequence[str], faults: str | Path | None
) -> Assembled:
    """Read the files of a config, append the faults of a script, and apply settings.

    Mistakes are collected in the result instead of being raised.

    Args:
        name_or_path: Name of a bundled config, or path of a TOML file.
        overrides: Settings `key.sub=value`, applied in order. Paths in them are relative to the
            current folder.
        faults: Name or path of a fault script whose faults are appended. None for no script.
    """
    mistakes: list[Mistake] = []
    tables: Tables = {}
    folder = CONFIGS
    with collect_mistakes(mistakes):
        path = _locate_config(name_or_path, "config", CONFIGS)
        folder = path.parent
        tables = _read_config(path, (), {}, mistakes)
    is_whole = not mistakes
    if faults is not None:
        with collect_mistakes(mistakes):
            tables = append_faults(tables, faults, folder)
    invalid: list[Mistake] = []
    overridden = apply_settings(tables, overrides, invalid)
    # If a file is missing, settings cannot be checked, because they may refer to its tables.
    anchored = resolve_paths(overridden if is_whole else tables, Path.cwd())
    broken = frozenset(find_table_name(setting.value) for setting in invalid)
    return Assembled(anchored, [*mistakes, *invalid], broken, is_whole)


@contextmanager
def collect_mistakes(mistakes: list[Mistake]) -> Iterator[None]:
    """Return a context manager that catches a `ConfigError` and adds its mistakes to a list.

    The rest of the `with` block is skipped.
    """
    try:
        yield
    except ConfigError as error:
        mistakes += error.mistakes


def list_level_classes(tables: Tables) -> tuple[str, ...]:
    """Return the level classes named in unvalidated tables, as "package.module:Class"."""
    boards = [board for board in _get_table(tables, "board").values() if isinstance(board, dict)]
    names = [board.get(role) for board in boards for role in ("executor", "planner")]
    names += [LAN_ADAPTER] if "lan" in _get_table(tables, "adapter") else []
    return tuple(dict.fromkeys(name for name in names if isinstance(name, str)))


def append_faults(tables: Tables, name_or_path: str | Path, folder: Path) -> Tables:
    """Return the tables of a config with the faults of a script appended.

    Args:
        tables: Tables of the config.
        name_or_path: Name or path of the script, which contains `[[fault]]` tables only. A name is
            looked up in the rack's folder and then among the bundled scripts.
        folder: Folder of the rack's config.

    Raises:
        ConfigError: The script cannot be read or contains something else.
    """
    folders = [FAULTS] if folder == CONFIGS else [folder, FAULTS]
    path = _locate_config(name_or_path, "--faults", *folders)
    script = _read_tables(path)
    why = "a fault script contains [[fault]] tables and nothing else"
    if mistakes := [
        Mistake(f"{path.name}: {key}", None, why)
        for key, value in script.items()
        if key != "fault" or not isinstance(value, list)
    ]:
        raise ConfigError(mistakes)
    faults = tables.get("fault")
    own = faults if isinstance(faults, list) else []
    return {**tables, "fault": [*own, *script.get("fault", [])]}


def name_config(path: str) -> str:
    """Return the name of a bundled config, given its path. Any other path is returned unchanged."""
    stem = Path(path).with_suffix("")
    if not stem.is_relative_to(CONFIGS):
        return path
    parts = stem.relative_to(CONFIGS).parts
    return "/".join(parts[:-1] if len(parts) > 1 and parts[-1] == parts[-2] else parts)


def list_names(folder: Path = CONFIGS) -> list[str]:
    """Return the names of the configs in a folder. The default is the folder of bundled racks.

    The config `<name>` is the file `<name>.toml` or `<name>/<name>.toml`. Further files in that
    subfolder that contain the key `name` are racks too, called `<name>/<file>`.
    """
    rack_names = [path.stem for path in folder.glob("*.toml")]
    for main in (path for path in folder.glob("*/*.toml") if path.stem == path.parent.name):
        rack_names += [
            main.stem if path == main else f"{main.stem}/{path.stem}"
            for path in main.parent.glob("*.toml")
            if path == main or "name" in _read_tables(path)
        ]
    return sorted(rack_names)


def find_file(path: Path) -> Path | None:
    """Return the absolute path of a file, which may also be a device or a pipe.

    Returns:
        None if the file does not exist or the path is invalid, as with an unknown ~user.
    """
    try:
        path = path.expanduser()
        if path.is_file():
            return path.resolve()
        # Do not resolve links, because the file may be a link to a device.
        return path.absolute() if path.exists() and not path.is_dir() else None
    except (OSError, RuntimeError, ValueError):
        return None


def resolve_paths(tables: Tables, folder: Path) -> Tables:
    """Return a copy of tables in which all paths are absolute.

    A relative path is looked up in `folder`, then among the bundled files in configs/.
    """

    def find_file(text: str) -> str:
        """Return the absolute path of the file to which `text` refers, whether it exists or not."""
        return str(_find_referenced_file(text, folder) or folder / text)

    def find_config(text: str) -> str:
        """Return the absolute path of a config, or `text` itself if there is no such file."""
        return str(_find_referenced_file(text, folder) or text)

    for keys, change in (
        (("robot", "model"), find_file),
        (("python_path",), lambda text: str((folder / text).resolve())),
        (("adapter", ANY, "certificates"), lambda text: str(folder / text)),
        (("adapter", ANY, "launch"), find_config),
        (("adapter", ANY, "partners"), find_config),
        (STATE_TABLES, find_file),
    ):
        tables = change_texts(tables, keys, change)
    return tables


def change_texts(value: Any, keys: Sequence[str], change: Callable[[str], str]) -> Any:
    """Return a copy of nested tables in which the texts under a sequence of keys are changed.

    Args:
        value: The tables.
        keys: Keys that lead to a text or a list of texts. `ANY` matches every key. Values of other
            types are not changed.
        change: Function from the old to the new text.
    """
    if keys and isinstance(value, dict):
        key, *rest = keys
        return {
            name: change_texts(item, rest, change) if key in (name, ANY) else item
            for name, item in value.items()
        }
    if not keys and isinstance(value, list):
        return [change_texts(item, (), change) for item in value]
    return change(value) if not keys and isinstance(value, str) else value


def _get_table(tables: Tables, key: str) -> Tables:
    """Return the table under a key. Empty if the key is missing or its value is not a table."""
    table = tables.get(key)
    return table if isinstance(table, dict) else {}


def shorten_path(model: Path) -> str:
    """Return a path as text, relative to configs/ if the file is bundled."""
    return model.relative_to(CONFIGS).as_posix() if model.is_relative_to(CONFIGS) else str(model)


def _locate_config(name_or_path: str | Path, place: str, *folders: Path) -> Path:
    """Return the file of a config or script. Raises `ConfigError` at `place` if it is not found."""
    text = str(name_or_path)
    is_path = isinstance(name_or_path, Path) or "/" in text or text.endswith(".toml")
    if is_path and (file := find_file(Path(text))):
        return file
    # Listing the names reads every config, so do it only if the text is not a file.
    if is_path:
        known = [folder for folder in folders if text in list_names(folder)]
    else:
        known = [*folders, Path.cwd()]
    named = next((file for folder in known if (file := _find_named_config(text, folder))), None)
    if named is None:
        known_names = list_names(folders[-1])
        near = get_close_matches(text, known_names, 1)
        valid = f"valid are a path or one of the names {', '.join(known_names)}"
        why = f"did you mean '{near[0]}'?" if near else valid
        raise ConfigError([Mistake(place, text, f"no such file; {why}")])
    return named


def _read_config(
    path: Path, chain: tuple[Path, ...], known: dict[Path, Tables], mistakes: list[Mistake]
) -> Tables:
    """Return the merged tables of a file and all files that it extends, reading each file once.

    Args:
        path: The file.
        chain: The files that led to it, each of which extends the next.
        known: Tables of the files that have been read, because several may extend the same file.
        mistakes: List to which mistakes are added.
    """
    if path in known:
        return known[path]
    with collect_mistakes(mistakes):
        why = ""
        if path in chain:
            loop = " -> ".join(p.name for p in (*chain[chain.index(path) :], path))
            why = f"extends itself: {loop}"
        elif len(chain) >= MAX_DEPTH:
            why = f"the chain of extended files is longer than {MAX_DEPTH} files"
        if why:
            raise ConfigError([Mistake(f"{path.name}: extends", None, why)])
        top = resolve_paths(_read_tables(path), path.parent)
        merged: Tables = {}
        for base in _list_bases(top.pop("extends", []), path, mistakes):
            merged = _merge_extension(merged, _read_config(base, (*chain, path), known, mistakes))
        known[path] = _merge_extension(merged, top)
    return known.setdefault(path, {})


def _merge_extension(base: Tables, top: Tables) -> Tables:
    """Return `base` updated with `top`. If `top` names a robot model, drop `[robot]` of `base`."""
    if "model" in _get_table(top, "robot"):
        base = {key: value for key, value in base.items() if key != "robot"}
    return merge_tables(base, top)


def _read_tables(path: Path) -> Tables:
    """Read the tables of one TOML file. Raises `ConfigError` if it cannot be read or parsed."""
    try:
        text = read_regular_file(path, MAX_FILE_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", error)
        raise ConfigError([Mistake(str(path), None, f"cannot be read: {why}")]) from None
    return parse_tables(text, path.name)


def _list_bases(extends: Any, path: Path, mistakes: list[Mistake]) -> list[Path]:
    """Return the files listed under `extends`. Add a mistake for each that does not exist."""
    place = f"{path.name}: extends"
    if not isinstance(extends, list) or not all(isinstance(item, str) for item in extends):
        raise ConfigError([Mistake(place, extends, "must be a list of config names or paths")])
    bases = []
    for item in extends:
        base = (
            _find_referenced_file(item, path.parent)
            or _find_referenced_file(f"{item}.toml", path.parent)
            or _find_named_config(item)
        )
        if base is None:
            known = ", ".join(list_names())
            why = f"no such file next to {path.name} or among the bundled configs: {known}"
            mistakes.append(Mistake(place, item, why))
        else:
            bases.append(base)
    return bases


def _find_named_config(name: str, folder: Path = CONFIGS) -> Path | None:
    """Return the file of the config `name` in a folder. None if there is no such file."""
    return find_file(folder / f"{name}.toml") or find_file(folder / name / f"{name}.toml")


def _find_referenced_file(reference: str, folder: Path) -> Path | None:
    """Return the file to which a path in a config refers. None if it does not exist.

    Args:
        reference: The path, absolute or relative to `folder` or to configs/, tried in this order.
        folder: Folder of the config.
    """
    return find_file(folder / reference) or find_file(CONFIGS / reference)
