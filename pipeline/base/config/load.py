"""Read params.yaml and other YAML of sections: the only place that reads YAML."""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from pipeline.base.config.section import Section
from pipeline.base.config.sections import Params
from pipeline.base.errors import ConfigError

_Section = TypeVar("_Section", bound=Section)

_REPLACED: dict[tuple[str, ...], str] = {
    ("train_head", "val_fraction"): "is no longer a key, for episodes are split three ways. Write "
    "train_head.split={val: 0.15, test: 0.15}: val chooses the checkpoint and stops early, test is "
    "what stages.evaluate reports on"
}
"""Keys of earlier versions, and what takes their place."""


def load_params(path: Path, overrides: Sequence[str] = ()) -> Params:
    """The params of a YAML file with `section.key=value` overrides laid over it.

    A value is YAML, so `[1, 2]`, `null` and JSON work. Raises `ConfigError` with every problem.
    """
    hint = "Run from the project's root or pass --params FILE."
    document = _read(path, hint)
    for override in overrides:
        _lay_over(document, override)
    try:
        return Params.model_validate(document)
    except ValidationError as error:
        where = f"{path} with what --set lays over it" if overrides else str(path)
        raise ConfigError(_all_problems(error, where, Params)) from None


def load_section(path: Path, section: type[_Section]) -> _Section:
    """A section that stands in a YAML file of its own.

    Raises `ConfigError` with every problem, by file and key.
    """
    try:
        return section.model_validate(_read(path, "Say where it is."))
    except ValidationError as error:
        raise ConfigError(_all_problems(error, str(path), section)) from None


def _read(path: Path, hint: str) -> dict[str, Any]:
    """The keys of a YAML file; `hint` is what to do where there is none."""
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file. {hint}") from None
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise ConfigError(f"{path}: cannot be read as YAML: {error}") from None
    if not isinstance(document, dict):
        raise ConfigError(f"{path}: expected sections such as `data:`, found {document!r}")
    return document


def _lay_over(document: dict[str, Any], override: str) -> None:
    dotted, equals, text = override.partition("=")
    keys = dotted.split(".")
    if not equals or len(keys) < 2 or not all(keys):
        raise ConfigError(f"--set {override}: expected section.key=value")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"--set {override}: the value is not YAML (put a text that begins with a brace or a "
            f"bracket in quotes of its own): {error}"
        ) from None
    node = document
    for depth, key in enumerate(keys[:-1], start=1):
        child = node.get(key)
        if child is None:
            child = node[key] = {}
        if not isinstance(child, dict):
            raise ConfigError(
                f"--set {override}: {'.'.join(keys[:depth])} is a {type(child).__name__}, "
                "not a section; set it whole"
            )
        node = child
    node[keys[-1]] = value


def _all_problems(error: ValidationError, where: str, root: type[BaseModel]) -> str:
    lines = [f"{where}: {error.error_count()} problem(s)"]
    for problem in error.errors():
        place = ".".join(str(part) for part in problem["loc"]) or root.__name__.lower()
        match problem["type"]:
            case "extra_forbidden":
                said = _unknown_key(problem["loc"], root)
            case "tuple_type":
                said = f"expected a list, such as [{problem['input']}]"
            case _:
                said = problem["msg"].removeprefix("Value error, ")
                if not isinstance(problem["input"], dict):  # a whole section would bury it
                    said += f" (found {problem['input']!r:.200})"
        lines.append(f"  {place}: {said}")
    return "\n".join(lines)


def _unknown_key(place: tuple[int | str, ...], root: type[BaseModel]) -> str:
    """The key that was likely meant, else all that may stand there."""
    if (replaced := _REPLACED.get(tuple(map(str, place)))) is not None:
        return replaced
    section: Any = root
    for part in place[:-1]:
        if isinstance(part, str) and part in section.model_fields:
            section = _section_in(section.model_fields[part].annotation)
    known = list(section.model_fields)
    meant = get_close_matches(str(place[-1]), known, n=1)
    if meant:
        return f"unknown key; did you mean {meant[0]}?"
    return f"unknown key; expected one of: {', '.join(known)}"


def _section_in(annotation: Any) -> Any:
    """The section that a field holds, or that its tuple does."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return _section_in(next(part for part in get_args(annotation) if part is not Ellipsis))
