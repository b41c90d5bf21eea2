"""Is a store laid out as the contract says: metadata, attributes, and no file too many."""

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.base.errors import StoreIncomplete
from pipeline.store.integrity.findings import Damage
from pipeline.store.metadata import metadata_damage
from pipeline.store.schema import (
    ARRAY_NAMES,
    FEATURES,
    KEYS,
    ROW_MULTIPLE,
    SCHEMA,
    ArraySpec,
    Sizes,
    arrays,
    chunk_paths,
    read_spec,
)

GROUPS = sorted({name.split("/")[0] for name in ARRAY_NAMES})
_CHUNK_KEYS = {"name": "default", "configuration": {"separator": "/"}}
NO_DIGEST = "an earlier version wrote it without a metadata_digest: attributes cannot be checked"


def read_arrays(root: Path) -> tuple[dict[str, ArraySpec], list[Damage]]:
    """The arrays whose metadata can be read and are as the contract says, and what is not."""
    found: dict[str, ArraySpec] = {}
    damaged: list[Damage] = []
    for name in ARRAY_NAMES:
        try:
            found[name] = read_spec(root, name)
        except StoreIncomplete as error:
            damaged.append(_metadata(root, name, str(error)))
    for name, expected in _expected(found).items():
        if name in found:
            wrong = list(_differences(root, found[name], expected))
            damaged += [_metadata(root, name, what) for what in wrong]
            if wrong:
                del found[name]
    return found, damaged


def check_attributes(
    root: Path, attrs: Mapping[str, Any], specs: Mapping[str, ArraySpec]
) -> list[Damage]:
    """What is missing from the root attributes, or does not fit the arrays."""
    kinds: dict[str, type[Any] | tuple[type[Any], ...]] = {
        "schema": int,
        "feature_spec": dict,
        "sources": list,
        "streams": dict,
        "action_hz": (int, float, type(None)),
        "vlm_reuse_count": int,
        "environment": list,
        "plan": str,
    }
    wrong = [
        f"the attribute {name} is {'not what it must be' if name in attrs else 'missing'}"
        for name, kind in kinds.items()
        if name not in attrs or not isinstance(attrs[name], kind)
    ]
    if attrs.get("schema") != SCHEMA:
        wrong.append(f"expected schema {SCHEMA}, found {attrs.get('schema')!r}")
    if not wrong and attrs["vlm_reuse_count"] < 1:
        wrong.append(f"expected a vlm_reuse_count of 1 or more, found {attrs['vlm_reuse_count']}")
    if not wrong:
        wrong += _widths(root, attrs, specs)
    return [Damage("", None, root / "zarr.json", what) for what in wrong]


def check_digest(root: Path) -> list[Damage]:
    """What is wrong with the metadata that only their digest can tell."""
    try:
        what = metadata_damage(root)
    except StoreIncomplete as error:
        what = str(error)
    return [Damage("", None, root / "zarr.json", what)] if what else []


def strange_files(root: Path, specs: Mapping[str, ArraySpec]) -> list[str]:
    """Files that have no place in a store."""
    expected = {root / "zarr.json", *(root / group / "zarr.json" for group in GROUPS)}
    expected |= {root / name / "zarr.json" for name in ARRAY_NAMES}
    expected |= {path for spec in specs.values() for path in chunk_paths(root, spec)}
    unjudged = tuple(str(root / name) + "/" for name in ARRAY_NAMES if name not in specs)
    found = (Path(folder) / file for folder, _, files in os.walk(root) for file in files)
    return [
        f"{path}: has no place in a store, look at it and remove it"
        for path in sorted(found)
        if path not in expected and not str(path).startswith(unjudged)
    ]


def _widths(root: Path, attrs: Mapping[str, Any], specs: Mapping[str, ArraySpec]) -> Iterator[str]:
    """Where a number of channels or slots is another than that of their names."""
    streams = attrs["streams"]
    for stream, array in (
        ("action", "tick/action"),
        ("sensor", "sensor/values"),
        ("state", "state/values"),
    ):
        names = streams.get(stream, {}).get("names", ())
        if array in specs and len(names) != specs[array].shape[1]:
            yield f"{len(names)} names of {stream} channels, {array} has {specs[array].shape[1]}"
    views = streams.get("views", ())
    if "vl/frame_time" in specs and len(views) != specs["vl/frame_time"].shape[1]:
        yield f"{len(views)} views, vl/frame_time has {specs['vl/frame_time'].shape[1]}"
    try:
        slots = json.loads((root / "vl" / "zarr.json").read_text())["attributes"]["slots"]
    except (OSError, ValueError, KeyError) as error:
        yield f"{root / 'vl' / 'zarr.json'}: the names of the slots cannot be read ({error!r})"
        return
    if FEATURES in specs and len(slots) != specs[FEATURES].shape[1]:
        yield f"{len(slots)} slots are named, {FEATURES} has {specs[FEATURES].shape[1]}"


def _expected(found: Mapping[str, ArraySpec]) -> dict[str, ArraySpec]:
    """The arrays as they would have to be, going by the size that most have of each axis."""
    sizes: dict[str, Counter[int]] = {}
    for name, spec in arrays(Sizes(*[0] * 12), "float32", "float32").items():
        if name in found and len(found[name].shape) == len(spec.shape):
            for axis, size in zip(spec.dimensions, found[name].shape, strict=True):
                # The bytes of a key and those of the text have one name.
                axis = "key" if name == KEYS and axis == "byte" else axis
                sizes.setdefault(axis, Counter())[size] += 1

    def most(axis: str) -> int:
        return sizes[axis].most_common(1)[0][0] if axis in sizes else 0

    features = found.get(FEATURES)
    dtype = features.attributes.get("dtype", features.dtype.name) if features else "float32"
    sensor = found["sensor/values"].dtype.name if "sensor/values" in found else "float32"
    expected = Sizes(
        episodes=most("episode"),
        ticks=most("tick"),
        vl_rows=most("vl_row"),
        readings=most("sensor_reading"),
        states=most("state_reading"),
        text_bytes=most("byte"),
        slots=most("slot"),
        dim=most("dim"),
        views=most("view"),
        action_dim=most("action_dim"),
        sensor_channels=most("channel"),
        state_dim=most("state_dim"),
    )
    return arrays(
        expected,
        dtype if dtype in ("float32", "float16", "bfloat16") else "float32",
        sensor if sensor in ("float32", "float16") else "float32",
    )


def _differences(root: Path, found: ArraySpec, expected: ArraySpec) -> Iterator[str]:
    """Where the metadata of an array depart from the contract."""
    for what in ("shape", "dtype", "dimensions", "attributes"):
        ours, theirs = getattr(expected, what), getattr(found, what)
        if ours != theirs:
            yield f"expected the {what} {ours}, found {theirs}"
    document = json.loads((root / found.name / "zarr.json").read_text())
    chunks = tuple(document["chunk_grid"]["configuration"]["chunk_shape"])
    whole = tuple(max(1, size) for size in found.shape[1:])
    if chunks[1:] != whole or chunks[0] % ROW_MULTIPLE:
        yield (
            f"expected chunks of a multiple of {ROW_MULTIPLE} whole rows {whole}, found {chunks}"
        )
    keys = document["chunk_key_encoding"]
    if {**_CHUNK_KEYS, **keys} != _CHUNK_KEYS:
        yield f"expected the chunk keys {_CHUNK_KEYS}, found {keys}"
    ordered = {"endian": "little"} if found.dtype.itemsize > 1 else None
    codecs = [(one["name"], one.get("configuration")) for one in document["codecs"]]
    if codecs != [("bytes", ordered), ("crc32c", None)]:
        yield f"expected the codecs bytes (little), crc32c, found {document['codecs']}"


def _metadata(root: Path, name: str, what: str) -> Damage:
    return Damage(name, None, root / name / "zarr.json", what)
