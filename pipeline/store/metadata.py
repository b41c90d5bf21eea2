"""A digest of all that a store says of itself: an attribute has no checksum of its own.

It covers the `zarr.json` of the root, of each group and of each array, as JSON of sorted keys; the
root's without the digest itself. Written when a build is finished.
"""

import hashlib
import json
from pathlib import Path
from typing import Any, cast

import zarr

from pipeline.base.errors import StoreIncomplete
from pipeline.store.repair_hints import mend
from pipeline.store.schema import ARRAY_NAMES

ATTRIBUTE = "metadata_digest"
_PLACES = ("", *sorted({name.split("/")[0] for name in ARRAY_NAMES}), *ARRAY_NAMES)


def note_metadata(root: Path) -> None:
    """Write the digest into the root's attributes; running it again changes nothing."""
    found, stored = _found_and_stored(root)
    if found != stored:
        group = zarr.open_group(root, mode="r+")
        group.attrs.put({**group.attrs.asdict(), ATTRIBUTE: found})


def metadata_damage(root: Path) -> str | None:
    """What is wrong with the metadata; None where they give their digest, or have none.

    Raises `StoreIncomplete` where they cannot be read.
    """
    found, stored = _found_and_stored(root)
    if stored is None or stored == found:
        return None
    return f"the metadata were changed: expected their digest {stored}, found {found}"


def check_metadata(root: Path) -> None:
    """Raise `StoreIncomplete` where the metadata of a finished store are not as written."""
    if what := metadata_damage(root):
        raise StoreIncomplete(f"{root / 'zarr.json'}: {what}. {mend(root)}")


def _found_and_stored(root: Path) -> tuple[str, Any]:
    documents = {place: _document(root / place / "zarr.json") for place in _PLACES}
    attributes = documents[""].get("attributes")
    stored = attributes.pop(ATTRIBUTE, None) if isinstance(attributes, dict) else None
    text = json.dumps(documents, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest(), stored


def _document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StoreIncomplete(f"{path}: cannot be read ({error}). {mend(path)}") from None
    if not isinstance(document, dict):
        raise StoreIncomplete(f"{path}: expected a JSON object. {mend(path)}")
    return cast("dict[str, Any]", document)
