"""A digest of all metadata of a store: an attribute has no checksum of its own.

It covers the `zarr.json` of the root, of each group and of each array, as JSON of sorted keys; the
root's without the digest itself. A finished store's root lists the checksum of every chunk file in
its place (`SEAL`), so that this one digest binds all that the store holds.
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
"""The attribute of the root that holds, by array, the trailers of its chunk files in order, in hex.
"""


def note_metadata(root: Path, attributes: Mapping[str, Any] | None = None) -> None:
    """Write attributes into the root, or those that it has, and the digest with them."""
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
    """Raise `StoreIncomplete` where the metadata of a finished store are not as written."""
    if what := metadata_damage(root):
        raise store_border(root).refusal(root / "zarr.json", what)


def _digests(root: Path, attributes: Mapping[str, Any] | None = None) -> tuple[str, Any]:
    """That of the metadata as they are, or would be with other attributes of the root, and the one
    that stands in the attributes."""
    kept = dict(group_attributes(root) if attributes is None else attributes)
    stored = kept.pop(ATTRIBUTE, None)
    places, border = ("", *GROUPS, *ARRAY_NAMES), store_border(root)
    documents = {at: border.read_json(root / at / "zarr.json", dict[str, Any]) for at in places}
    documents[""]["attributes"] = kept
    text = json.dumps(documents, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest(), stored
