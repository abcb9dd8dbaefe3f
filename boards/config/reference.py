"""Every key of a config with type, unit, range, default and meaning, from the models that validate
it.

`[task]` and the tables `params` of boards are declared by the levels' classes, so those tables
depend on the config.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import ModelSchema

from rack.boards.config.files import EXTENDS
from rack.boards.config.rules.mailboxes import exchange, ports
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.config.wiring import Wiring
from rack.boards.errors import ConfigError, shown
from rack.boards.faults.kind import KINDS, Parameter
from rack.levels.tables import keys_of

UNIT = re.compile(
    r", ((?:kg m2|N s/m|N/\(m s\)|N/m|N m/rad|N"
    r" m|N|rad/s[23]?|rad|m/s|mm|m|ms|us|1/s|s|Hz|ticks|cycles)"
    r"(?: or (?:rad/s|rad|N m s/rad|N m/rad|N m))?)(?=$|[;:,])"
)
"""The unit in a description: between a comma and the end, or further punctuation."""
REQUIRED = "required"
WHOLE = "rack"
"""Name of the table for keys outside any table."""

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


class Place(NamedTuple):
    """The place of a table in TOML: its path, whether it is an item of a list, and the key that
    selects its variant."""

    path: str
    is_list: bool = False
    variant: str = ""

    @property
    def heading(self) -> str:
        """The heading of the table in TOML."""
        if not self.path:
            return "(top of the file)"
        text = f"[[{self.path}]]" if self.is_list else f"[{self.path}]"
        return f"{text} with {self.variant}" if self.variant else text


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
    missing class."""
    wiring = Wiring(config)
    if mistakes := [*ports(wiring), *exchange(wiring)]:
        raise ConfigError(mistakes)
    whole, *found = _tables(RackConfig, WHOLE, Place(""))
    extends = Key("extends", "list of strings", "", "", "", EXTENDS)
    found = [replace(whole, keys=(extends, *whole.keys)), *found, *_fault_kinds()]
    for program in wiring.programs:
        found += _tables(program, "task", Place("task"))
    for board, params in wiring.params:
        # Of the network adapter's board the table is `[adapter.lan]`.
        if config.adapter.lan is None or board != f"board.{LAN}":
            found += _tables(params, f"{board}.params", Place(f"{board}.params"))
    return found


def find_tables(name: str, config: RackConfig) -> list[KeyTable]:
    """Return the table `name`, or all whose names begin with it. Raises `LookupError` with the
    existing tables."""
    known = {found.name: found for found in key_tables(config)}
    wanted = name.strip("[]")
    start, _, rest = wanted.partition(".")
    board, _, rest = rest.partition(".")
    is_own = bool(rest) and bool(_within(wanted, known))
    if start in ("board", "host") and board in (*getattr(config, start), "<name>") and not is_own:
        wanted = f"{start}.{rest}" if rest else start
    found = [known[wanted]] if wanted in known else [known[name] for name in _within(wanted, known)]
    if not found:
        top = dict.fromkeys(name.partition(".")[0] for name in known)
        raise LookupError(
            f"no such table; tables: {', '.join(top)}, and others listed by 'rack schema'"
        )
    return found


def _within(name: str, known: Iterable[str]) -> list[str]:
    """Return the names of a table and of those in it."""
    return [other for other in known if f"{other}.".startswith(f"{name}.")]


def _tables(model: type[BaseModel], name: str, place: Place) -> Iterator[KeyTable]:
    schema = model.model_json_schema(schema_generator=DescribedSchema)
    yield from _walk(schema, schema.get("$defs", {}), name, place)


def _walk(schema: Schema, known: Schema, name: str, place: Place) -> Iterator[KeyTable]:
    """Yield a table, then its subtables."""
    properties = schema.get("properties", {})
    required = schema.get("required", ())
    inner = {key: list(_inner(entry, known, Place(key))) for key, entry in properties.items()}
    keys = [
        _key(key, properties[key], key in required) for key, found in inner.items() if not found
    ]
    if keys:
        yield KeyTable(name, place.heading, _summary(schema.get("description", "")), tuple(keys))
    for key, found in inner.items():
        for entry, at in found:
            variant = at.variant.rpartition(" ")[2].strip('"')
            parts = [key, variant] if name == WHOLE else [name, key, variant]
            below = ".".join(filter(None, parts))
            yield from _walk(
                entry, known, below, at._replace(path=f"{place.path}.{at.path}".lstrip("."))
            )


def _inner(entry: Schema, known: Schema, at: Place) -> Iterator[tuple[Schema, Place]]:
    """Yield the tables that a value may be or contain, each with its place."""
    if "$ref" in entry:
        yield known[entry["$ref"].rpartition("/")[2]], at
    for option in entry.get("anyOf", ()):
        yield from _inner(option, known, at)
    for value, ref in entry.get("discriminator", {}).get("mapping", {}).items():
        variant = f'{entry["discriminator"]["propertyName"]} = "{value}"'
        yield known[ref.rpartition("/")[2]], at._replace(variant=variant)
    if isinstance(entry.get("items"), dict):
        yield from _inner(entry["items"], known, at._replace(is_list=True))
    for held in (entry.get("additionalProperties"), *entry.get("patternProperties", {}).values()):
        if isinstance(held, dict):
            yield from _inner(held, known, at._replace(path=f"{at.path}.<name>"))


def _key(name: str, entry: Schema, is_required: bool) -> Key:
    description = entry.get("description", "")
    found = UNIT.search(description)
    unit = found[1] if found else ""
    given = entry.get("default")
    default = "" if given in (None, [], {}) else shown(given)
    if is_required:
        default = REQUIRED
    return Key(
        name=name,
        type=_type(entry),
        unit=unit,
        permitted=_permitted(entry),
        default=default,
        meaning=UNIT.sub("", description, count=1) + "; live: `rack set`" * ("live" in entry),
    )


def _options(entry: Schema) -> list[Schema]:
    return [option for option in entry.get("anyOf", [entry]) if option.get("type") != "null"]


def _type(entry: Schema) -> str:
    return " or ".join(_type_of(option) for option in _options(entry))


def _type_of(entry: Schema) -> str:
    kind = "path" if entry.get("format") == "path" else entry.get("type", "any")
    kind = {"array": "list", "object": "table"}.get(kind, kind)
    if (held := _held(entry)) is None:
        return kind
    count = f"{len(entry['prefixItems'])} " if "prefixItems" in entry else ""
    return f"{kind} of {count}{_plural(held)}"


def _held(entry: Schema) -> Schema | None:
    """Return the schema of the items of a list or table of like items; None for other types."""
    places = (entry.get("items"), *entry.get("prefixItems", ()), entry.get("additionalProperties"))
    held = (*places, *entry.get("patternProperties", {}).values())
    return next((found for found in held if isinstance(found, dict)), None)


def _plural(entry: Schema) -> str:
    first, _, rest = _type(entry).partition(" ")
    return f"{first}s {rest}".rstrip()


def _permitted(entry: Schema) -> str:
    return next((text for option in _options(entry) if (text := _range(option))), "")


def _range(entry: Schema) -> str:
    """Return the permitted values of a type; for a list, those of its items."""
    values = [entry["const"]] if "const" in entry else entry.get("enum")
    if values:
        return ", ".join(map(shown, values))
    if (held := _held(entry)) is not None:
        count = (
            f"{entry['minItems']} to {entry['maxItems']} items"
            if "maxItems" in entry and "items" in entry
            else ""
        )
        return "; ".join(filter(None, (count, _permitted(held))))
    low, high, above, below = (
        _number(entry[key]) if key in entry else ""
        for key in ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum")
    )
    if low and high:
        return f"{low} to {high}"
    bounds = []
    if low:
        bounds.append(f"{low} or more")
    elif above:
        bounds.append(f"above {above}")
    if high:
        bounds.append(f"at most {high}")
    elif below:
        bounds.append(f"below {below}")
    return ", ".join(bounds)


def _number(value: float) -> str:
    text = f"{value:g}"
    return text if float(text) == value else str(value)


def _summary(docstring: str) -> str:
    """Return the first sentence of a table's docstring, without its heading."""
    text = " ".join(docstring.partition("\n\n")[0].split())
    text = re.sub(r"^`\[.*?\]`: ", "", text).partition(". ")[0].rstrip(".")
    return text[:1].lower() + text[1:]


def _key_of(parameter: Parameter) -> Key:
    kind = "integer" if parameter.is_whole else "number"
    unit = "" if parameter.unit == "1" else parameter.unit
    default = REQUIRED if parameter.default is None else _number(parameter.default)
    permitted = f"{_number(parameter.least)} to {_number(parameter.most)}"
    return Key(parameter.name, kind, unit, permitted, default, parameter.meaning)


def _fault_kinds() -> Iterator[KeyTable]:
    """Yield a table for every kind of fault with parameters: the keys of its `[[fault]]` besides
    the common ones."""
    for kind in KINDS:
        keys = [_key_of(parameter) for parameter in kind.parameters]
        if keys:
            yield KeyTable(
                f"fault.{kind.name}",
                f'[[fault]] with kind = "{kind.name}"',
                kind.means,
                tuple(keys),
            )
