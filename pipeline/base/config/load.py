"""Read params.yaml and other YAML of sections: the only place that reads YAML."""

import json
import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from pipeline.base.border import Border, named, problems, shown
from pipeline.base.config.section import Section
from pipeline.base.config.sections import Params
from pipeline.base.errors import ConfigError

_Section = TypeVar("_Section", bound=Section)

_MOST_BYTES, _MOST_VALUES, _MOST_LEVELS = 2**20, 50_000, 50
"""Of a document; those of people have a hundredth."""
_NUMBERS = ("!!int", "!!float", "!!bool", "!!null")
_MOST_TOLD = 50
"""Problems that one message lists."""
_FILE = Border(ConfigError, "Run from the project's root, name it (--params FILE), or correct it.")
_SET = Border(
    ConfigError,
    "The value is YAML: put a text that it reads as something else in quotes of its own, as in "
    "--set 'section.key=\"a text\"'.",
)
_REPLACED = {
    "train_head.val_fraction": "is no longer a key, for episodes are split three ways. Write "
    "train_head.split={val: 0.15, test: 0.15}: val chooses the checkpoint and stops early, test is "
    "what stages.evaluate reports on",
    **dict.fromkeys(
        ("export.int8", "export.int8_tolerance"),
        "is no longer a key: a head in int8 was hardly faster and mostly refused, as 0.07 to 0.10 "
        "training std off the policy. Remove it",
    ),
}
"""Keys of earlier versions, and what takes their place."""


def load_params(path: Path, overrides: Sequence[str] = ()) -> Params:
    """The params of a YAML file with `section.key=value` overrides laid over it.

    A value is YAML, so `[1, 2]`, `null` and JSON work. Raises `ConfigError` with every problem.
    """
    document = _read(path)
    for override in overrides:
        _lay_over(document, override)
    where = f"{path} with what --set lays over it" if overrides else str(path)
    return _as_section(document, Params, where)


def load_section(path: Path, section: type[_Section]) -> _Section:
    """A section that stands in a YAML file of its own.

    Raises `ConfigError` with every problem, by file and key.
    """
    return _as_section(_read(path), section, str(path))


def setting(key: str, value: Path | Sequence[str]) -> str:
    """`--set key=value` for advice: typed into a shell as it is printed, it gives this value."""
    text = str(value)
    if not re.fullmatch(r"[\w./+-]+", text) or _parse(text, _SET, text) != text:
        text = json.dumps(value, ensure_ascii=False, default=str)
        text = text if text.isprintable() else json.dumps(value, default=str)
    return f"--set {shlex.quote(f'{key}={text}')}"


def _read(path: Path) -> dict[str, Any]:
    """The keys of a YAML file."""
    document = _parse(_FILE.read_bytes(path, _MOST_BYTES), _FILE, path)
    if not isinstance(document, dict):
        raise _FILE.refusal(path, f"expected sections such as `data:`, found {shown(document)}")
    return document


def _lay_over(document: dict[str, Any], override: str) -> None:
    dotted, equals, text = override.partition("=")
    where, keys = f"--set {named(override)}", dotted.split(".")
    if not equals or len(keys) < 2 or not all(keys):
        raise _SET.refusal(where, "expected section.key=value")
    value, node = _parse(text, _SET, where), document
    for depth, key in enumerate(keys[:-1], start=1):
        child = node.get(key)
        if child is None:
            child = node[key] = {}
        if not isinstance(child, dict):
            above = named(".".join(keys[:depth]))
            why = f"{above} is a {type(child).__name__}, not a section; set it whole"
            raise _SET.refusal(where, why)
        node = child
    node[keys[-1]] = value


class _Loader(yaml.SafeLoader):
    """YAML of texts, numbers, true, false, null, lists and sections; a date is a text."""

    yaml_implicit_resolvers = {  # noqa: RUF012
        first: [(tag, pattern) for tag, pattern in known if not tag.endswith(":timestamp")]
        for first, known in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    left = _MOST_VALUES

    def value(self, node: yaml.Node, depth: int = 1) -> Any:
        """What a node holds. An alias gives a value of its own, which counts each time."""
        self.left -= 1
        if self.left < 0 or depth > _MOST_LEVELS:
            at_most = f"at most {_MOST_VALUES:,} values in {_MOST_LEVELS} levels"
            raise _wrong(node, f"expected {at_most}, found more")
        tag = node.tag.replace("tag:yaml.org,2002:", "!!")
        found = named(tag)
        if isinstance(node, yaml.SequenceNode) and tag == "!!seq":
            return [self.value(inner, depth + 1) for inner in node.value]
        if isinstance(node, yaml.MappingNode) and tag == "!!map":
            values, merged = dict[str, Any](), dict[str, Any]()
            for key_node, inner in node.value:
                if key_node.tag == "tag:yaml.org,2002:merge":
                    given = self.value(inner, depth + 1)
                    for one in reversed(given if isinstance(given, list) else [given]):
                        if not isinstance(one, dict):
                            raise _wrong(inner, f"expected a section to merge, found {shown(one)}")
                        merged |= one
                    continue
                key = self.value(key_node, depth + 1)
                if not isinstance(key, str) or key in values:
                    said = f"expected a text that stands once as a key, found {shown(key)}"
                    raise _wrong(key_node, said)
                values[key] = self.value(inner, depth + 1)
            return merged | values
        if isinstance(node, yaml.ScalarNode):
            found = f"{found} {shown(node.value)}"
            with suppress(ValueError, KeyError):  # half a surrogate pair, a bool that is none
                if tag == "!!str" and len(node.value) <= 10_000 and "\0" not in node.value:
                    return node.value.encode("utf-16", "surrogatepass").decode("utf-16")
                # As it would be without the tag: yaml takes `!!float --1` for 1.
                plain = self.resolve(yaml.ScalarNode, node.value, (True, False)) == node.tag
                if plain and tag in _NUMBERS and len(node.value) <= 400:
                    return self.construct_object(node)
        raise _wrong(
            node,
            "expected a text (Unicode, no NUL, at most 10,000 characters), a number (at most 400), "
            f"true, false, null, a list or a section, found {found}",
        )


def _wrong(node: yaml.Node, why: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=why, problem_mark=node.start_mark)


def _parse(text: bytes | str, border: Border, where: Path | str) -> Any:
    """The one document of a text."""
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        return None if node is None else loader.value(node)
    except RecursionError:
        why = f"expected at most {_MOST_LEVELS} levels, found more"
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        at = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        why = f"{at}{error.problem:.1000}"
    except yaml.reader.ReaderError as error:
        why = f"character {error.position + 1}: {error.reason}"
    raise border.refusal(where, f"cannot be read as YAML: {why}")


def _as_section(document: dict[str, Any], section: type[_Section], where: str) -> _Section:
    try:
        return section.model_validate(document)
    except ValidationError as error:
        lines = [f"{named(where)}: {error.error_count()} problem(s)"]
        for place, said in islice(problems(error), _MOST_TOLD):
            if said.startswith("unknown key"):
                said = _REPLACED.get(place) or _unknown_key(place.split("."), section)
            lines.append(f"  {place or section.__name__.lower()}: {said}")
        lines.append(f"Correct {'it' if len(lines) == 2 else 'them'}, and run the same again.")
        raise ConfigError("\n".join(lines)) from None


def _unknown_key(place: Sequence[str], root: type[BaseModel]) -> str:
    """The key that was likely meant, else all that may stand there."""
    section: Any = root
    for part in place[:-1]:
        if part in section.model_fields:
            section = _section_in(section.model_fields[part].annotation)
    known = list(section.model_fields)
    if meant := get_close_matches(place[-1], known, n=1):
        return f"unknown key; did you mean {meant[0]}?"
    return f"unknown key; expected one of: {', '.join(known)}"


def _section_in(annotation: Any) -> Any:
    """The section that a field holds, or that its tuple does."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return _section_in(next(part for part in get_args(annotation) if part is not Ellipsis))
