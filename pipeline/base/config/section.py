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


Place = Annotated[Path, AfterValidator(_without_home)]
"""A file or folder."""
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


class Section(BaseModel):
    """Base of every section: immutable, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

    @field_validator("*", mode="wrap")
    @classmethod
    def _no_truth_for_a_number(cls, value: Any, parse: ValidatorFunctionWrapHandler) -> Any:
        parsed = parse(value)
        if isinstance(value, bool) and not isinstance(parsed, bool):
            raise ValueError("expected a number, found true or false")
        return parsed
