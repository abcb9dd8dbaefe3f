"""Reference of all config keys, generated from the models that validate a config.

Each key has a type, unit, range, default and meaning. The classes of the levels declare `[task]`
and the `params` of boards, so these tables depend on the config.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from rack.boards.config.connections import Wiring, find_executors
from rack.boards.config.files import EXTENDS
from rack.boards.config.rules.mailboxes import check_exchange, check_ports
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.errors import ConfigError, format_value
from rack.boards.faults.kind import KINDS
from rack.levels.tables import describe_keys

REQUIRED = "required"
NAME = ".<name>"
BOUNDS = {
    "exclusiveMinimum": "above",
    "minimum": "at least",
    "exclusiveMaximum": "below",
    "maximum": "at most",
}
"""Bounds of a number by their names in JSON schema, in words. The last one of a side is used."""

Schema = Mapping[str, Any]


@dataclass(frozen=True)
class Key:
    """One key of a table.

    Attributes:
        name: Name of the key.
        type: Type of its value, as in "list of numbers".
        unit: Unit of its value. Empty if it has none.
        permitted: Valid values. Empty if any value of the type is valid.
        default: Default value as text, or "required". Empty if the key may be left out.
        meaning: What the key does.
    """

    name: str
    type: str
    unit: str
    permitted: str
    default: str
    meaning: str


@dataclass(frozen=True)
class KeyTable:
    """One table of a config.

    Attributes:
        name: Name for look-ups, as in "board.budget".
        heading: Its heading in TOML, as in "[board.<name>.budget]".
        meaning: What the table describes.
        keys: Its keys, in the order of their declaration.
    """

    name: str
    heading: str
    meaning: str
    keys: tuple[Key, ...]


class DescribedSchema(GenerateJsonSchema):
    """Generator of JSON schemas that include the description of each key."""

    def model_schema(self, schema: ModelSchema) -> JsonSchemaValue:
        """Return the JSON schema of one table."""
        json_schema = super().model_schema(schema)
        for key, field in describe_keys(schema["cls"]).items():
            json_schema["properties"][key]["description"] = field.description or ""
        return json_schema


def list_key_tables(config: RackConfig) -> list[KeyTable]:
    """Return every table that a config with the boards of this config may contain.

    Raises:
        ConfigError: A class that the config names cannot be used, or its ports do not fit.
    """
    wiring = Wiring(config)
    if mistakes := [*check_ports(wiring), *check_exchange(wiring)]:
        raise ConfigError(mistakes)
    top, *tables = _list_model_tables(RackConfig, "")
    extends = Key("extends", "list of strings", "", "", "", EXTENDS)
    top = KeyTable("rack", "(top of the file)", top.meaning, (extends, *top.keys))
    tables = [top, *tables, *_list_fault_tables()]
    for program in wiring.programs:
        tables += _list_model_tables(program, "task")
    for board, params in wiring.params:
        # The parameters of the network adapter are written in `[adapter.lan]`.
        if config.adapter.lan is None or board != f"board.{LAN}":
            tables += _list_model_tables(params, f"{board}.params")
    for board, level in find_executors(config).items():
        if kinds := level.finding_kinds.values():
            heading = f"(events of board.{board})"
            keys = [Key(k.name, "number", k.unit.removeprefix("1"), "", "", k.doc) for k in kinds]
            meaning = "what the level may report"
            tables.append(KeyTable(f"board.{board}.findings", heading, meaning, tuple(keys)))
    return tables


def find_tables(name: str, config: RackConfig) -> list[KeyTable]:
    """Return the table called `name` or, if there is none, the tables inside it.

    For example, the result for "adapter" is the table "adapter.lan".

    Raises:
        LookupError: There is no such table. The message lists the top-level tables.
    """
    known = {table.name: table for table in list_key_tables(config)}
    parts = name.strip("[]").split(".")
    tables = [".".join(parts)]
    if (
        parts[0] in ("board", "host")
        and len(parts) > 1
        and parts[1] in (*getattr(config, parts[0]), "<name>")
    ):
        # The keys that all boards have in common are listed under "board", without a board's name.
        tables.append(".".join(parts[:1] + parts[2:]))
    for table in tables:
        if table in known:
            return [known[table]]
    if inner := [known[name] for name in known if name.startswith(f"{tables[-1]}.")]:
        return inner
    top = dict.fromkeys(name.partition(".")[0] for name in known)
    raise LookupError(
        f"no such table; tables: {', '.join(top)}, and others that 'rack schema' lists"
    )


def _list_model_tables(model: type[BaseModel], path: str) -> Iterator[KeyTable]:
    """Yield the table that a model declares, at `path` in a config, and the tables inside it."""
    schema = model.model_json_schema(schema_generator=DescribedSchema)
    return _walk_schema(schema, schema.get("$defs", {}), path, path, f"[{path}]")


def _walk_schema(
    schema: Schema, known: Schema, name: str, path: str, heading: str
) -> Iterator[KeyTable]:
    """Yield the table that a schema describes, followed by the tables inside it.

    Args:
        schema: JSON schema of the table.
        known: Schemas to which `$ref` entries refer, keyed by name.
        name: Name of the table for look-ups.
        path: Place of the table in the config.
        heading: Heading of the table in TOML.
    """
    keys = []
    inner: list[KeyTable] = []
    for key, entry in schema.get("properties", {}).items():
        below = f"{path}.{key}".lstrip(".")
        inner_name = f"{name}.{key}".lstrip(".")
        if tables := [*_list_inner_tables(entry, known, inner_name, below, f"[{below}]")]:
            inner += tables
        else:
            keys.append(_describe_key(key, entry, key in schema.get("required", ())))
    if keys:
        meaning = _summarise_docstring(schema.get("description", ""))
        yield KeyTable(name, heading, meaning, tuple(keys))
    yield from inner


def _list_inner_tables(
    entry: Schema, known: Schema, name: str, path: str, heading: str
) -> Iterator[KeyTable]:
    """Yield the tables that a key with this schema declares.

    The key's value may be a table, or a list or table of tables. `entry` is the schema of the key.
    See `_walk_schema` for the other arguments.
    """
    if "$ref" in entry:
        yield from _walk_schema(known[entry["$ref"].rpartition("/")[2]], known, name, path, heading)
    for option in entry.get("anyOf", ()):
        yield from _list_inner_tables(option, known, name, path, heading)
    kinds = entry.get("discriminator", {"mapping": {}})
    for value, ref in kinds["mapping"].items():
        chosen = f'{heading} with {kinds["propertyName"]} = "{value}"'
        yield from _list_inner_tables({"$ref": ref}, known, f"{name}.{value}", path, chosen)
    if isinstance(entry.get("items"), dict):
        yield from _list_inner_tables(entry["items"], known, name, path, f"[[{path}]]")
    for value_schema in _list_value_schemas(entry):
        yield from _list_inner_tables(value_schema, known, name, f"{path}{NAME}", f"[{path}{NAME}]")


def _list_value_schemas(entry: Schema) -> Iterator[Schema]:
    """Yield the schemas of the values in a table whose keys the user chooses."""
    values = (entry.get("additionalProperties"), *entry.get("patternProperties", {}).values())
    yield from (value for value in values if isinstance(value, dict))


def _describe_key(name: str, entry: Schema, is_required: bool) -> Key:
    """Convert the JSON schema of a key to a `Key`."""
    # A description declares the unit in brackets, as in "tick period [ms]; a whole number of ns".
    before, _, rest = entry.get("description", "").partition(" [")
    unit, _, after = rest.partition("]")
    default = entry.get("default")
    default_text = "" if default in (None, [], {}) else format_value(default)
    kind, permitted = _describe_values(entry)
    return Key(
        name=name,
        type=kind,
        unit=unit,
        permitted=permitted[0] if permitted else "",
        default=REQUIRED if is_required else default_text,
        meaning=before + after + "; live: `rack set`" * ("live" in entry),
    )


def _describe_values(entry: Schema) -> tuple[str, list[str]]:
    """Return the type of a value, and the valid values of each alternative type that has limits.

    For a list or table, the limits apply to each item.
    """
    kinds = []
    limits = []
    for option in entry.get("anyOf", [entry]):
        kind = "path" if option.get("format") == "path" else option.get("type", "any")
        kind = {"array": "list", "object": "table"}.get(kind, kind)
        listed = option.get("prefixItems", ())
        places = (option.get("items"), *listed, *_list_value_schemas(option))
        item = next((place for place in places if isinstance(place, dict)), None)
        if item is None:
            permitted = _format_limits(option)
        else:
            item_type, inner = _describe_values(item)
            first, _, rest = item_type.partition(" ")
            count = f"{len(listed)} " if listed else ""
            kind = f"{kind} of {count}{first}s {rest}".rstrip()
            if "maxItems" in option and "items" in option:
                inner = [f"{option['minItems']} to {option['maxItems']} items", *inner]
            permitted = "; ".join(inner)
        if kind != "null":
            kinds.append(kind)
            limits += [permitted] if permitted else []
    return " or ".join(kinds), limits


def _format_limits(entry: Schema) -> str:
    """Return the valid values of a number, string or boolean as text. Empty without limits."""
    if values := entry.get("enum", [entry["const"]] if "const" in entry else []):
        return ", ".join(map(format_value, values))
    if {"minimum", "maximum"} <= entry.keys():
        return f"{_format_number(entry['minimum'])} to {_format_number(entry['maximum'])}"
    bounds = {
        key.removeprefix("exclusive").lower(): f"{word} {_format_number(entry[key])}"
        for key, word in BOUNDS.items()
        if key in entry
    }
    return ", ".join(bounds.values())


def _format_number(value: float) -> str:
    """Return a number as text, with six significant digits if they represent it exactly."""
    text = f"{value:g}"
    return text if float(text) == value else str(value)


def _summarise_docstring(docstring: str) -> str:
    """Return the first sentence of a table's docstring, without the heading in TOML before it."""
    text = " ".join(docstring.partition("\n\n")[0].split())
    text = text.rpartition("]`: ")[2].partition(". ")[0].rstrip(".")
    return text[:1].lower() + text[1:]


def _list_fault_tables() -> Iterator[KeyTable]:
    """Yield a table of parameters for each fault kind that has parameters."""
    for kind in KINDS:
        keys = [
            Key(
                name=param.name,
                type="integer" if param.is_whole else "number",
                unit="" if param.unit == "1" else param.unit,
                permitted=f"{_format_number(param.least)} to {_format_number(param.most)}",
                default=REQUIRED if param.default is None else _format_number(param.default),
                meaning=param.meaning,
            )
            for param in kind.parameters
        ]
        if keys:
            heading = f'[[fault]] with kind = "{kind.name}"'
            yield KeyTable(f"fault.{kind.name}", heading, kind.means, tuple(keys))
