"""Every key of a config with type, unit, range, default and meaning, from the models that validate
it.

`[task]` and the tables `params` of boards are declared by the levels' classes, so those tables
depend on the config.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from rack.boards.config.connections import Wiring, executors
from rack.boards.config.files import EXTENDS
from rack.boards.config.rules.mailboxes import exchange, ports
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.errors import ConfigError, shown
from rack.boards.faults.kind import KINDS
from rack.levels.ports import FindingKind
from rack.levels.tables import keys_of

REQUIRED = "required"
NAME = ".<name>"
LEAST = {"minimum": "at least", "exclusiveMinimum": "above"}
MOST = {"maximum": "at most", "exclusiveMaximum": "below"}
"""Bounds of a number, as JSON schema calls them, and in words; the first one counts."""

Schema = Mapping[str, Any]


@dataclass(frozen=True)
class Key:
    """One key of a table. Empty texts: no unit, any value permitted, no default."""

    name: str
    type: str
    unit: str
    permitted: str
    default: str
    meaning: str


@dataclass(frozen=True)
class KeyTable:
    """One table of a config: name, as in "board.budget", TOML heading, meaning and keys."""

    name: str
    heading: str
    meaning: str
    keys: tuple[Key, ...]


class DescribedSchema(GenerateJsonSchema):
    """The JSON schema of a table, with the descriptions of its keys."""

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """Return the schema of one table."""
        found = super().model_schema(schema)
        for key, field in keys_of(schema["cls"]).items():
            found["properties"][key]["description"] = field.description or ""
        return found


def key_tables(config: RackConfig) -> list[KeyTable]:
    """Return every table that a config of these boards may contain. Raises `ConfigError` for a
    missing class.
    """
    wiring = Wiring(config)
    if mistakes := [*ports(wiring), *exchange(wiring)]:
        raise ConfigError(mistakes)
    whole, *found = _tables(RackConfig, "")
    extends = Key("extends", "list of strings", "", "", "", EXTENDS)
    whole = KeyTable("rack", "(top of the file)", whole.meaning, (extends, *whole.keys))
    found = [whole, *found, *_fault_kinds()]
    for program in wiring.programs:
        found += _tables(program, "task")
    for board, params in wiring.params:
        # Of the network adapter's board the table is `[adapter.lan]`.
        if config.adapter.lan is None or board != f"board.{LAN}":
            found += _tables(params, f"{board}.params")
    found += [
        _findings(board, kind.finding_kinds)
        for board, kind in executors(config).items()
        if kind.finding_kinds
    ]
    return found


def find_tables(name: str, config: RackConfig) -> list[KeyTable]:
    """Return the table `name`, or all whose names begin with it. Raises `LookupError` with the
    existing tables.
    """
    known = {found.name: found for found in key_tables(config)}
    parts = name.strip("[]").split(".")
    tables = [".".join(parts)]
    if (
        parts[0] in ("board", "host")
        and len(parts) > 1
        and (parts[1] in (*getattr(config, parts[0]), "<name>"))
    ):
        # What all boards have in common is described once.
        tables.append(".".join(parts[:1] + parts[2:]))
    for table in tables:
        if table in known:
            return [known[table]]
    if found := [known[name] for name in known if name.startswith(f"{tables[-1]}.")]:
        return found
    top = dict.fromkeys(name.partition(".")[0] for name in known)
    raise LookupError(
        f"no such table; tables: {', '.join(top)}, and others listed by 'rack schema'"
    )


def _tables(model: type[BaseModel], path: str) -> Iterator[KeyTable]:
    schema = model.model_json_schema(schema_generator=DescribedSchema)
    return _walk(schema, schema.get("$defs", {}), path, path, f"[{path}]")


def _walk(schema: Schema, known: Schema, name: str, path: str, heading: str) -> Iterator[KeyTable]:
    """Yield a table, then those in it."""
    keys = []
    inner: list[KeyTable] = []
    for key, entry in schema.get("properties", {}).items():
        below = f"{path}.{key}".lstrip(".")
        found = [*_inner(entry, known, f"{name}.{key}".lstrip("."), below, f"[{below}]")]
        inner += found
        if not found:
            keys.append(_key(key, entry, key in schema.get("required", ())))
    if keys:
        yield KeyTable(name, heading, _summary(schema.get("description", "")), tuple(keys))
    yield from inner


def _inner(entry: Schema, known: Schema, name: str, path: str, heading: str) -> Iterator[KeyTable]:
    """Yield the tables that a value may be or contain."""
    if "$ref" in entry:
        yield from _walk(known[entry["$ref"].rpartition("/")[2]], known, name, path, heading)
    for option in entry.get("anyOf", ()):
        yield from _inner(option, known, name, path, heading)
    kinds = entry.get("discriminator", {"mapping": {}})
    for value, ref in kinds["mapping"].items():
        chosen = f'{heading} with {kinds["propertyName"]} = "{value}"'
        yield from _inner({"$ref": ref}, known, f"{name}.{value}", path, chosen)
    if isinstance(entry.get("items"), dict):
        yield from _inner(entry["items"], known, name, path, f"[[{path}]]")
    for held in _named(entry):
        yield from _inner(held, known, name, f"{path}{NAME}", f"[{path}{NAME}]")


def _named(entry: Schema) -> Iterator[Schema]:
    """Yield the schemas of the values of a table whose keys are names of the user's own."""
    held = (entry.get("additionalProperties"), *entry.get("patternProperties", {}).values())
    yield from (found for found in held if isinstance(found, dict))


def _key(name: str, entry: Schema, is_required: bool) -> Key:
    before, _, rest = entry.get("description", "").partition(" [")
    unit, _, after = rest.partition("]")
    given = entry.get("default")
    default = "" if given in (None, [], {}) else shown(given)
    kind, permitted = _values(entry)
    return Key(
        name=name,
        type=kind,
        unit=unit,
        permitted=permitted[0] if permitted else "",
        default=REQUIRED if is_required else default,
        meaning=before + after + "; live: `rack set`" * ("live" in entry),
    )


def _values(entry: Schema) -> tuple[str, list[str]]:
    """Return the type of a value, and the permitted values of each of its alternatives that has
    limits; of a list or table of like items, those of the items.
    """
    kinds = []
    limits = []
    for option in entry.get("anyOf", [entry]):
        kind = "path" if option.get("format") == "path" else option.get("type", "any")
        kind = {"array": "list", "object": "table"}.get(kind, kind)
        listed = option.get("prefixItems", ())
        places = (option.get("items"), *listed, *_named(option))
        held = next((found for found in places if isinstance(found, dict)), None)
        if held is None:
            permitted = _limits(option)
        else:
            of, inner = _values(held)
            first, _, rest = of.partition(" ")
            count = f"{len(listed)} " if listed else ""
            kind = f"{kind} of {count}{first}s {rest}".rstrip()
            if "maxItems" in option and "items" in option:
                inner = [f"{option['minItems']} to {option['maxItems']} items", *inner]
            permitted = "; ".join(inner)
        if kind != "null":
            kinds.append(kind)
            limits += [permitted] if permitted else []
    return " or ".join(kinds), limits


def _limits(entry: Schema) -> str:
    """Return the permitted values of a value that contains no others."""
    if values := entry.get("enum", [entry["const"]] if "const" in entry else []):
        return ", ".join(map(shown, values))
    if {"minimum", "maximum"} <= entry.keys():
        return f"{_number(entry['minimum'])} to {_number(entry['maximum'])}"
    bounds = [
        next((f"{word} {_number(entry[key])}" for key, word in kinds.items() if key in entry), "")
        for kinds in (LEAST, MOST)
    ]
    return ", ".join(filter(None, bounds))


def _number(value: float) -> str:
    text = f"{value:g}"
    return text if float(text) == value else str(value)


def _summary(docstring: str) -> str:
    """Return the first sentence of a table's docstring, without its heading."""
    text = " ".join(docstring.partition("\n\n")[0].split())
    text = text.rpartition("]`: ")[2].partition(". ")[0].rstrip(".")
    return text[:1].lower() + text[1:]


def _findings(board: str, kinds: Mapping[str, FindingKind]) -> KeyTable:
    """Return the events that a level reports itself as a table, though none is a key."""
    keys = tuple(
        Key(kind.name, "number", kind.unit.removeprefix("1"), "", "", kind.doc)
        for kind in kinds.values()
    )
    return KeyTable(
        f"board.{board}.findings", f"(events of board.{board})", "what the level may report", keys
    )


def _fault_kinds() -> Iterator[KeyTable]:
    """Yield a table for every kind of fault with parameters: the keys of its `[[fault]]` besides
    the common ones.
    """
    for kind in KINDS:
        keys = [
            Key(
                name=each.name,
                type="integer" if each.is_whole else "number",
                unit="" if each.unit == "1" else each.unit,
                permitted=f"{_number(each.least)} to {_number(each.most)}",
                default=REQUIRED if each.default is None else _number(each.default),
                meaning=each.meaning,
            )
            for each in kind.parameters
        ]
        if keys:
            heading = f'[[fault]] with kind = "{kind.name}"'
            yield KeyTable(f"fault.{kind.name}", heading, kind.means, tuple(keys))
