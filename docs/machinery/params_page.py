"""The page of parameters, written from the models in `pipeline.base.config`.

It goes by their JSON schema, pydantic's own description of them, and refuses what it has no words
for: a key is never left out or half described.
"""

import json
from collections.abc import Iterator
from typing import Any

from pipeline.base.config import Params

Schema = dict[str, Any]

PLACE = "<!-- The site lists every key from here on. -->"
"""In `docs/params.md`: what stands behind it is for those who read the file itself."""
SIMPLE = {
    "string": "text",
    "integer": "whole number",
    "number": "number",
    "boolean": "true or false",
    "null": "null",
}


def params_page(markdown: str) -> str:
    """The page with its keys: a heading a section and a section within one, a key an entry."""
    introduction, place, _ = markdown.partition(PLACE)
    assert place, f"docs/params.md: no {PLACE}"
    schema = Params.model_json_schema()
    definitions: Schema = schema["$defs"]
    parts = [introduction]
    for name, section in schema["properties"].items():
        parts += _section(definitions[_reference(section) or ""], name, "##", definitions)
    return "\n".join(parts)


def _section(model: Schema, place: str, heading: str, definitions: Schema) -> Iterator[str]:
    """A section's own keys, then the sections that its keys hold, or hold lists of."""
    yield f"{heading} {place} {{ #{place.replace('[]', '-each')} }}\n\n{model['description']}\n"
    required = model.get("required", ())
    within: dict[str, Schema] = {}
    entries: list[str] = []
    for name, schema in model["properties"].items():
        inner = _reference(schema.get("items", schema))
        listed = schema.get("type") == "array"
        if inner is not None and "properties" in definitions[inner]:
            within[f"{place}.{name}{'[]' if listed else ''}"] = definitions[inner]
            if not listed:
                continue
        said = schema.get("description", model["description"])
        entries.append(_entry(f"{place}.{name}", schema, said, name in required, definitions))
    yield '<div class="parameters" markdown>\n\n' + "\n".join(entries) + "\n</div>\n"
    for full, beneath in within.items():
        yield from _section(beneath, full, "###", definitions)


def _reference(schema: Schema) -> str | None:
    return schema["$ref"].rpartition("/")[2] if "$ref" in schema else None


def _entry(name: str, schema: Schema, said: str, required: bool, definitions: Schema) -> str:
    anchor = name.replace("[]", "")
    default = "**has to be given**" if required else f"default {_code(_default(schema))}"
    takes = words(schema, definitions)
    return f"`{name}`{{ #{anchor} }} {takes}; {default}\n:   {' '.join(said.split())}\n"


def words(schema: Schema, definitions: Schema) -> str:
    """What a key takes, in plain words, its range with it."""
    if name := _reference(schema):
        return "section" if "properties" in definitions[name] else words(definitions[name], {})
    if "const" in schema:
        return _code(schema["const"])
    if "enum" in schema:
        return _either([_code(value) for value in schema["enum"]])
    if options := schema.get("anyOf", schema.get("oneOf")):
        return _either([words(one, definitions) for one in options])
    if "prefixItems" in schema:
        return f"list of ({'), ('.join(words(one, definitions) for one in schema['prefixItems'])})"
    if schema["type"] == "array":
        least = f", at least {schema['minItems']}" if schema.get("minItems") else ""
        each = words(schema["items"], definitions)
        return f"list of {'sections' if each == 'section' else f'({each})'}{least}"
    if schema["type"] == "object":
        names = words(schema["propertyNames"], definitions) if "propertyNames" in schema else "text"
        values = schema["additionalProperties"]
        return f"mapping from {names} to {'any' if values is True else words(values, definitions)}"
    if schema.get("format") == "path":
        return "path"
    return SIMPLE[schema["type"]] + _range(schema)


def _range(schema: Schema) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    over, under = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    said = [
        *([f"from {low:g} to {high:g}"] if low is not None and high is not None else []),
        *([f"at least {low:g}"] if low is not None and high is None else []),
        *([f"at most {high:g}"] if high is not None and low is None else []),
        *([f"above {over:g}"] if over is not None else []),
        *([f"below {under:g}"] if under is not None else []),
        *(["not empty"] if schema.get("minLength") else []),
    ]
    return f", {', '.join(said)}" if said else ""


def _either(words_: list[str]) -> str:
    return words_[0] if len(words_) == 1 else f"{', '.join(words_[:-1])} or {words_[-1]}"


def _default(schema: Schema) -> Any:
    """Where pydantic makes a default with a function the schema has none: an empty mapping."""
    return schema.get("default", {})


def _code(value: Any) -> str:
    return f"`{value if isinstance(value, str) and chr(10) not in value else json.dumps(value)}`"
