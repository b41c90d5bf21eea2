"""A digest of all metadata of a store, because an attribute has no checksum of its own.

It covers the `zarr.json` of the root (without the digest itself), of each group and of each array,
as JSON with sorted keys. A finished store's root lists the checksum of every chunk file by its
place (`SEAL`), so that this one digest covers everything in the store.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import zarr

from pipeline.base.border import shown
from pipeline.store.border import store_border
from pipeline.store.paths import group_attributes
from pipeline.store.schema import ARRAY_NAMES, GROUPS

ATTRIBUTE = "metadata_digest"
SEAL = "seal"
"""The root's attribute with the trailers of each array's chunk files, in order, in hex."""


def note_metadata(root: Path, attributes: Mapping[str, Any] | None = None) -> None:
    """Write the digest into the root, with these attributes or else those that it has."""
    digest, _ = _digests(root, attributes)
    kept = group_attributes(root) if attributes is None else attributes
    zarr.open_group(root, mode="r+").attrs.put({**kept, ATTRIBUTE: digest})


def metadata_damage(root: Path) -> str | None:
    """What is wrong with the metadata; None where they give their digest.

    Raises `StoreIncomplete` where they cannot be read.
    """
    actual, stored = _digests(root)
    if stored == actual:
        return None
    return f"the metadata were changed: expected their digest {shown(stored)}, found {actual}"


def check_metadata(root: Path) -> None:
    """Raise `StoreIncomplete` where the metadata of a finished store were changed."""
    if what := metadata_damage(root):
        raise store_border(root).refusal(root / "zarr.json", what)


def _digests(root: Path, attributes: Mapping[str, Any] | None = None) -> tuple[str, Any]:
    """The digest of the metadata, computed with these root attributes or else those on disk, and
    the digest stored in the attributes."""
    kept = dict(group_attributes(root) if attributes is None else attributes)
    stored = kept.pop(ATTRIBUTE, None)
    places, border = ("", *GROUPS, *ARRAY_NAMES), store_border(root)
    documents = {at: border.read_json(root / at / "zarr.json", dict[str, Any]) for at in places}
    documents[""]["attributes"] = kept
    text = json.dumps(documents, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest(), stored
