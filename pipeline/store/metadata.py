"""A digest of all that a store says of itself: an attribute has no checksum of its own.

It covers the `zarr.json` of the root, of each group and of each array, as JSON of sorted keys; the
root's without the digest itself. Written when a build is finished.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zarr

from pipeline.base.errors import StoreIncomplete
from pipeline.store.repair_hints import mend
from pipeline.store.schema import ARRAY_NAMES, GROUPS

ATTRIBUTE = "metadata_digest"


def note_metadata(root: Path, attributes: Mapping[str, Any] | None = None) -> None:
    """Write attributes into the root, or those that it has, and the digest with them."""
    digest, _ = _digests(root, attributes)
    group = zarr.open_group(root, mode="r+")
    attributes = group.attrs.asdict() if attributes is None else attributes
    kept = {name: value for name, value in attributes.items() if name != ATTRIBUTE}
    group.attrs.put({**kept, ATTRIBUTE: digest})


def metadata_damage(root: Path) -> str | None:
    """What is wrong with the metadata; None where they give their digest.

    Raises `StoreIncomplete` where they cannot be read.
    """
    actual, stored = _digests(root)
    if stored is None or stored == actual:  # of an earlier version, which wrote none
        return None
    return f"the metadata were changed: expected their digest {stored}, found {actual}"


def check_metadata(root: Path) -> None:
    """Raise `StoreIncomplete` where the metadata of a finished store are not as written."""
    if what := metadata_damage(root):
        raise StoreIncomplete(f"{root / 'zarr.json'}: {what}. {mend(root)}")


def _digests(root: Path, attributes: Mapping[str, Any] | None = None) -> tuple[str, Any]:
    """That of the metadata as they are, or would be with other attributes of the root, and the one
    that stands in the attributes."""
    documents = {place: _read(root / place / "zarr.json") for place in ("", *GROUPS, *ARRAY_NAMES)}
    if attributes is not None:
        documents[""]["attributes"] = dict(attributes)
    stored = documents[""].get("attributes", {}).pop(ATTRIBUTE, None)
    text = json.dumps(documents, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest(), stored


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise StoreIncomplete(f"{path}: cannot be read ({error}). {mend(path)}") from None
