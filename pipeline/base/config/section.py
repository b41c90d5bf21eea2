"""What every section of params.yaml is made of."""

import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Fraction = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, lt=2**53)]


def _bounded(path: Path) -> Path:
    if len(str(path)) > 3000 or any(len(os.fsencode(part)) > 200 for part in path.parts):
        raise ValueError("expected a path of at most 3,000 characters, a name of at most 200 bytes")
    return path


Place = Annotated[Path, AfterValidator(_bounded)]
"""A file or folder; its name leaves room for the endings of what is written beside it."""


def _has_a_name(path: Path) -> Path:
    if not path.name:
        raise ValueError("must be a folder of its own")
    return path


OwnFolder = Annotated[Place, AfterValidator(_has_a_name)]
"""One that is written beside its place and renamed."""


class Section(BaseModel):
    """Base of every section: immutable, no unknown keys, no NaN or infinity."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )
