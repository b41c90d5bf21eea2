"""Is a store laid out as the contract says: metadata, attributes, and no file too many."""

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import zarr

from pipeline.base.differences import differences
from pipeline.base.errors import StoreIncomplete
from pipeline.base.issue import Issue
from pipeline.store.metadata import metadata_damage
from pipeline.store.schema import (
    ARRAY_NAMES,
    FEATURES,
    GROUPS,
    ROW_MULTIPLE,
    ArraySpec,
    Sizes,
    arrays,
    chunk_paths,
    read_spec,
)

_ATTRIBUTES: dict[str, type[Any] | tuple[type[Any], ...]] = {
    "feature_spec": dict,
    "sources": list,
    "streams": dict,
    "action_hz": (int, float, type(None)),
    "vlm_reuse_count": int,
    "environment": list,
}


def read_arrays(root: Path) -> tuple[dict[str, ArraySpec], list[Issue]]:
    """The arrays whose metadata can be read and are as the contract says, and what is not."""
    specs: dict[str, ArraySpec] = {}
    issues: list[Issue] = []
    lengths: dict[str, int] = {}
    # The arrays that hold nothing but positions come last, and say how long the others must be.
    for name in reversed(ARRAY_NAMES):
        try:
            spec = read_spec(root, name)
            wrong = list(_differences(root, spec, lengths))
        except StoreIncomplete as error:
            wrong = [str(error)]
        else:
            if not wrong:
                specs[name] = spec
        issues += [metadata_issue(root, what, name) for what in wrong]
    return {name: specs[name] for name in ARRAY_NAMES if name in specs}, issues


def check_attributes(root: Path, attributes: Mapping[str, Any]) -> list[Issue]:
    """What is missing from the root attributes, or is not what it must be."""
    return [
        metadata_issue(root, f"the attribute {name} is missing, or not what it must be")
        for name, kind in _ATTRIBUTES.items()
        if name not in attributes or not isinstance(attributes[name], kind)
    ]


def check_digest(root: Path) -> list[Issue]:
    """What is wrong with the metadata that only their digest can tell."""
    try:
        what = metadata_damage(root)
    except StoreIncomplete as error:
        what = str(error)
    return [metadata_issue(root, what)] if what else []


def strange_files(root: Path, specs: Mapping[str, ArraySpec]) -> Iterator[Issue]:
    """Files that have no place in a store."""
    expected = {root / place / "zarr.json" for place in ("", *GROUPS, *ARRAY_NAMES)}
    expected |= {path for spec in specs.values() for path in chunk_paths(root, spec)}
    unjudged = tuple(str(root / name) + "/" for name in ARRAY_NAMES if name not in specs)
    files = (Path(folder) / file for folder, _, names in os.walk(root) for file in names)
    for path in sorted(files):
        if path not in expected and not str(path).startswith(unjudged):
            what = "has no place in a store, look at it and remove it"
            yield Issue(severity="error", kind="strange file", message=what, file=path)


def metadata_issue(root: Path, what: str, array: str = "") -> Issue:
    """What is wrong with the metadata of an array, or of the store."""
    file = root / array / "zarr.json"
    return Issue(severity="error", kind="metadata", message=what, stream=array, file=file)


def _differences(root: Path, spec: ArraySpec, lengths: dict[str, int]) -> Iterator[str]:
    """Where the metadata of an array depart from the contract, and from `lengths` by axis."""
    allowed = ("float32", "float16", *(["bfloat16"] if spec.name == FEATURES else []))
    dtype = spec.stored_dtype if spec.stored_dtype in allowed else "float32"
    sensor_dtype = "float32" if spec.name == FEATURES else dtype
    contract = arrays(Sizes(*[0] * 12), dtype, sensor_dtype)
    chunk_rows = None if spec.chunk_rows % ROW_MULTIPLE else spec.chunk_rows
    expected = replace(contract[spec.name], shape=spec.shape, stored_chunk_rows=chunk_rows)
    if len(expected.dimensions) != len(spec.shape):
        yield f"expected the axes {expected.dimensions}, found the shape {spec.shape}"
        return
    actual = zarr.open_array(root, path=spec.name, mode="r").metadata.to_dict()
    for place, (wanted, found) in differences(expected.document, actual).items():
        yield f"expected the {place} {wanted}, found {found}"
    for axis, length in zip(expected.dimensions, spec.shape, strict=True):
        if axis != "byte" and lengths.setdefault(axis, length) != length:
            yield f"expected the shape to have {lengths[axis]} along {axis}, found {length}"
