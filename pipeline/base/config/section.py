"""The base of every section of params.yaml, and types of its fields."""

import os
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidatorFunctionWrapHandler,
    field_validator,
)

Fraction = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, lt=2**53)]


_Paths = TypeVar("_Paths", Path, str, str | tuple[str, ...])


def _without_home(paths: _Paths) -> _Paths:
    """Refuse `~`, because DVC does not expand it."""
    for path in paths if isinstance(paths, tuple) else [str(paths)]:
        if path.startswith("~") and (place := os.path.expanduser(path)) != path:  # noqa: PTH111
            raise ValueError(f"~ is not expanded; write {place}")
    return paths


def _bounded(path: Path) -> Path:
    if len(str(path)) > 3000 or any(len(os.fsencode(part)) > 200 for part in path.parts):
        raise ValueError("expected a path of at most 3,000 characters, a name of at most 200 bytes")
    return path


Place = Annotated[Path, AfterValidator(_without_home), AfterValidator(_bounded)]
"""A file or folder; its name is short enough for the suffixes of files beside it."""
PathOrName = Annotated[str, AfterValidator(_without_home)]
"""A path or a hub id."""
Globs = Annotated[str | tuple[str, ...], AfterValidator(_without_home)]


def _is_apart(path: Path) -> Path:
    if not path.name:
        raise ValueError("must be a folder of its own")
    if stores := [part for part in path.parts[:-1] if ".zarr" in Path(part).suffixes]:
        raise ValueError(f"must not lie inside a store ({stores[0]})")
    return path


Output = Annotated[Place, AfterValidator(_is_apart)]
"""A folder that a command writes."""


def _keeps_truth(value: Any, parsed: Any) -> bool:
    """Whether no true or false was turned into a number."""
    if isinstance(value, dict) and isinstance(parsed, dict):
        return all(_keeps_truth(inner, parsed.get(key)) for key, inner in value.items())
    if isinstance(value, list | tuple) and isinstance(parsed, list | tuple):
        return all(map(_keeps_truth, value, parsed))
    return isinstance(parsed, bool) or not isinstance(value, bool)


class Section(BaseModel):
    """Base of every section: immutable, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

    @field_validator("*", mode="wrap")
    @classmethod
    def _no_truth_for_a_number(cls, value: Any, parse: ValidatorFunctionWrapHandler) -> Any:
        if not _keeps_truth(value, parsed := parse(value)):
            raise ValueError("expected a number, found true or false")
        return parsed
